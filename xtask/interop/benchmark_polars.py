"""polars: mean, std, min, max and five quantiles of each of the 32 dims that benchmark_rows.py wrote.

    python benchmark_polars.py set|flat DIR
"""
import sys, time, polars as pl
src = sys.argv[1]; K = 16
if src == "flat":
    lf = pl.scan_parquet(sys.argv[2] + "/../flat.parquet"); cols = [pl.col(f"d{i}") for i in range(32)]
else:
    lf = pl.scan_parquet(sys.argv[2] + "/data/chunk-000/file-000.parquet").select("observation.state", "action")
    cols = [pl.col(c).list.get(i).alias(f"{c}{i}") for c in ["observation.state", "action"] for i in range(K)]
lf = lf.select(cols)
names = lf.collect_schema().names()
agg = []
for n in names:
    c = pl.col(n)
    agg += [c.mean().alias(n+"m"), c.std(ddof=0).alias(n+"s"), c.min().alias(n+"a"), c.max().alias(n+"b")] + [c.quantile(q, "linear").alias(f"{n}q{q}") for q in [.01, .1, .5, .9, .99]]
t = time.time(); out = lf.select(agg).collect(); print(out.shape, round(time.time()-t, 2), "s", file=sys.stderr)
