"""The plain Python converter that gawm-ingest is compared with: decode every mapped message, write columns.

    python plain_converter.py LOG.mcap OUT.parquet

Needs: pip install mcap mcap-ros2-support pyarrow
"""

import sys
import time

import pyarrow as pa
import pyarrow.parquet as pq
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

log_path, out_path = sys.argv[1:3]
started = time.perf_counter()
columns = {"topic": [], "log_time": [], "stamp": [], "values": []}
with open(log_path, "rb") as log:
    reader = make_reader(log, decoder_factories=[DecoderFactory()])
    for _schema, channel, message, ros in reader.iter_decoded_messages():
        if hasattr(ros, "position"):
            values = list(ros.position) + list(ros.velocity)
        elif hasattr(ros, "orientation"):
            values = list(ros.orientation) + list(ros.angular_velocity) + list(ros.linear_acceleration)
        else:
            values = list(ros.data)
        stamp = ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec if hasattr(ros, "header") else message.publish_time
        columns["topic"].append(channel.topic)
        columns["log_time"].append(message.log_time)
        columns["stamp"].append(stamp)
        columns["values"].append(values)
rows = len(columns["topic"])
pq.write_table(pa.table(columns), out_path)
seconds = time.perf_counter() - started
print(f"{rows} messages in {seconds:.1f} s: {rows / seconds:.0f} messages/s")
