//! Rules of group TIME that need one run: order, gaps, drift, jitter, ages.

use super::{
    Finding, Severity, Thresholds,
    robust::{median, quantile},
};
use gawm_schema::Role;

use crate::read::{Dataset, EpisodeRows};

/// What is kept of a run's clock, for reports.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct TimeProfile {
    /// Median rate of the true time, or else of `timestamp`.
    pub(super) rate_hz: f64,
    /// Longest step, in periods.
    pub(super) longest_periods: f64,
    /// 95th percentile of jitter, in periods.
    pub(super) jitter_periods: f64,
}

/// Checks the clock of one run.
pub(super) fn time_profile(
    dataset: &Dataset,
    thresholds: &Thresholds,
    rows: &EpisodeRows,
) -> (TimeProfile, Vec<Finding>) {
    let mut findings = Vec::new();
    let mut profile = TimeProfile::default();
    let period = 1.0 / dataset.info.fps;
    let context = Context { thresholds, episode: rows.run.episode_index, period };
    if let Some(column) = rows.column("timestamp")
        && let Some(times) = column.dims().first()
        && column.nulls.n_rows == 0
    {
        profile = context.check_clock("timestamp", times, true, &mut findings);
        context.check_grid(times, rows.ints("frame_index"), &mut findings);
    }
    if let Some(times) = rows.ints("gawm.time_ns")
        && !times.is_empty()
        && times.iter().all(|t| *t != i64::MIN)
    {
        let seconds: Vec<f64> = times.iter().map(|t| t.wrapping_sub(times[0]) as f64 * 1e-9).collect();
        let rate = dataset.schema.as_ref().map_or(dataset.info.fps, |s| s.rate_hz);
        let context = Context { period: 1.0 / rate, ..context };
        profile = context.check_clock("gawm.time_ns", &seconds, false, &mut findings);
    }
    context.check_ages(dataset, rows, &mut findings);
    (profile, findings)
}

#[derive(Clone, Copy)]
struct Context<'a> {
    thresholds: &'a Thresholds,
    episode: i64,
    period: f64,
}

impl Context<'_> {
    fn finding(&self, code: &'static str, name: &str, message: String) -> Finding {
        Finding::new(code, message).episode(self.episode).feature(name)
    }

    fn check_clock(
        &self,
        name: &str,
        times: &[f64],
        is_nominal: bool,
        findings: &mut Vec<Finding>,
    ) -> TimeProfile {
        if let Some(row) = times.iter().position(|t| !t.is_finite()) {
            findings.push(
                self.finding("TIME-014", name, format!("{name} is {} in row {row}", times[row]))
                    .rows(row, row + 1),
            );
            return TimeProfile::default();
        }
        if times.len() < 3 {
            return TimeProfile::default();
        }
        let bounds = &self.thresholds.time;
        let steps: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
        self.events(
            "TIME-001",
            name,
            &steps,
            |s| s == 0.0,
            "rows have the time of the row before",
            None,
            findings,
        );
        let backward = "rows lie before the row before";
        self.events("TIME-002", name, &steps, |s| s < 0.0, backward, Some((-1.0, 0.0)), findings);
        // Single precision at large times: a step of one period is known to this.
        let rounding = if is_nominal { times[times.len() - 1].abs() * 2.4e-7 } else { 0.0 };
        let gap = bounds.gap_periods * self.period + rounding;
        let late = bounds.late_periods * self.period + rounding;
        let usual = median(&steps).max(0.0);
        let is_usual = |s: f64| s <= 1.5 * usual;
        let periods = Some((1.0 / self.period, bounds.gap_periods));
        self.events("TIME-003", name, &steps, |s| s > gap && !is_usual(s), "gaps", periods, findings);
        let n_late = steps.iter().filter(|s| **s > late && **s <= gap && !is_usual(**s)).count();
        if n_late > 0 {
            let message =
                format!("{n_late} rows come more than {} periods after the row before", bounds.late_periods);
            let row = steps.iter().position(|s| *s > late && *s <= gap).unwrap_or(0) + 1;
            findings.push(
                self.finding("TIME-003", name, message)
                    .rows(row, row + 1)
                    .at(Severity::Info)
                    .measured(n_late as f64, 0.0),
            );
        }
        let ordered: Vec<f64> =
            steps.iter().copied().filter(|s| *s > 0.0 && *s <= late.max(1.5 * usual)).collect();
        if ordered.len() >= 10 {
            self.check_rate(name, &ordered, times, is_nominal, findings);
        }
        let jitter: Vec<f64> = ordered.iter().map(|s| (s - usual).abs() / self.period).collect();
        let jitter_periods = quantile(&jitter, 0.95);
        if jitter_periods > bounds.jitter_periods && ordered.len() >= 20 {
            let message = format!(
                "95 % of the steps are within {:.0} % of a period of the usual step",
                100.0 * jitter_periods
            );
            findings.push(
                self.finding("TIME-007", name, message).measured(jitter_periods, bounds.jitter_periods),
            );
        }
        let longest = steps.iter().copied().fold(0.0, f64::max) / self.period;
        TimeProfile {
            rate_hz: if usual > 0.0 { 1.0 / usual } else { 0.0 },
            longest_periods: longest,
            jitter_periods,
        }
    }

    /// Compares the rate with the declared one, leaving gaps and disorder out.
    fn check_rate(
        &self,
        name: &str,
        ordered: &[f64],
        times: &[f64],
        is_nominal: bool,
        findings: &mut Vec<Finding>,
    ) {
        let bounds = &self.thresholds.time;
        let mean = ordered.iter().sum::<f64>() / ordered.len() as f64;
        let deviation = mean / self.period - 1.0;
        // What jitter and single precision leave unknown of the mean.
        let noise = quantile(&ordered.iter().map(|s| (s - mean).abs()).collect::<Vec<_>>(), 0.9);
        let precision =
            if is_nominal { times[times.len() - 1].abs().max(times[0].abs()) * 1.2e-7 } else { 0.0 };
        let doubt = (4.0 * noise / (ordered.len() as f64).sqrt() + 2.0 * precision / ordered.len() as f64)
            / self.period;
        if deviation.abs() > bounds.rate_share.max(doubt) {
            let message =
                format!("rows come at {:.3} Hz, declared are {:.3} Hz", 1.0 / mean, 1.0 / self.period);
            findings
                .push(self.finding("TIME-006", name, message).measured(deviation.abs(), bounds.rate_share));
        } else if deviation.abs() * 1e6 > bounds.drift_ppm && deviation.abs() > doubt {
            let ppm = deviation * 1e6;
            let after = deviation * self.period * times.len() as f64 * 1e3;
            let message = format!(
                "the clock runs {ppm:+.0} ppm against the declared rate: {after:+.1} ms at the end of the episode"
            );
            findings.push(self.finding("TIME-005", name, message).measured(ppm.abs(), bounds.drift_ppm));
        }
    }

    /// Compares `timestamp` with frame_index / fps, which lerobot looks videos up by.
    fn check_grid(&self, times: &[f64], frames: Option<&[i64]>, findings: &mut Vec<Finding>) {
        let tolerance = self.thresholds.time.grid_secs;
        let Some(first) = times.first().filter(|t| t.is_finite()) else { return };
        let origin = if frames.is_some() { frames.map_or(0, |f| f.first().copied().unwrap_or(0)) } else { 0 };
        let expected = |t: usize| t as f64 * self.period + origin.clamp(0, 1 << 40) as f64 * self.period;
        let start = first - expected(0);
        if start.abs() > tolerance {
            let mut message =
                format!("timestamp begins at {first:.4} s, frame_index / fps at {:.4} s", expected(0));
            // Where single precision cannot tell one row from the next.
            let is_lost = start.abs() * 1.2e-7 > 0.5 * self.period;
            if is_lost {
                message += ": single precision does not hold absolute times";
            }
            let finding =
                self.finding("TIME-004", "timestamp", message).rows(0, 1).measured(start.abs(), tolerance);
            findings.push(if is_lost { finding } else { finding.at(Severity::Info) });
        }
        let errors = times.iter().enumerate().map(|(t, time)| (time - start - expected(t)).abs());
        let worst = errors.enumerate().fold((0, 0.0), |w, (t, e)| if e > w.1 { (t, e) } else { w });
        let allowed = tolerance + times[times.len() - 1].abs() * 1.2e-7;
        if worst.1 > allowed {
            let message = format!(
                "timestamp is up to {:.4} s off frame_index / fps; loading needs tolerance_s = {:.1e}",
                worst.1, worst.1
            );
            findings.push(
                self.finding("TIME-004", "timestamp", message)
                    .rows(worst.0, worst.0 + 1)
                    .measured(worst.1, tolerance),
            );
        }
    }

    fn check_ages(&self, dataset: &Dataset, rows: &EpisodeRows, findings: &mut Vec<Finding>) {
        let bounds = &self.thresholds.time;
        let stream = |i: usize| {
            let streams = dataset.schema.as_ref().map(|s| s.streams.as_slice()).unwrap_or_default();
            streams.get(i).map_or_else(|| i.to_string(), |s| s.name.clone())
        };
        let ages = rows.column("gawm.age_ms").map(|c| c.dims()).unwrap_or_default();
        let arrivals = rows.column("gawm.arrival_age_ms").map(|c| c.dims()).unwrap_or_default();
        let stale = bounds.stale_periods * self.period * 1e3;
        // What acts between a row and the next may have been commanded up to a period after the row.
        let earliest_ms = |i: usize| {
            let role = dataset.schema.as_ref().and_then(|s| s.streams.get(i)?.role);
            if role == Some(Role::Action) { -self.period * 1e3 - 0.5 } else { -0.5 }
        };
        for (i, age) in ages.iter().enumerate() {
            let n_future = age.iter().filter(|a| **a < earliest_ms(i)).count();
            if n_future > 0 {
                let row = age.iter().position(|a| *a < earliest_ms(i)).unwrap_or(0);
                let message = format!(
                    "{n_future} rows use a sample of stream {} from up to {:.1} ms later",
                    stream(i),
                    -age[row]
                );
                findings.push(
                    self.finding("TIME-010", "gawm.age_ms", message)
                        .dim(&stream(i))
                        .rows(row, row + 1)
                        .measured(-age[row], 0.0),
                );
            }
            // A slow stream is old by nature: what counts is several times its usual age.
            let usual = median(age);
            let is_stale = |a: &&f64| a.is_finite() && **a > stale && **a > 4.0 * usual;
            if let Some(row) = age.iter().position(|a| is_stale(&a)) {
                let n_rows = age[row..].iter().take_while(|a| is_stale(a)).count();
                let worst = age.iter().filter(is_stale).copied().fold(0.0, f64::max);
                let message = format!("samples of stream {} are up to {worst:.0} ms old", stream(i));
                findings.push(
                    self.finding("TIME-011", "gawm.age_ms", message)
                        .dim(&stream(i))
                        .rows(row, row + n_rows)
                        .measured(worst, stale),
                );
            }
        }
        for (i, (age, arrival)) in ages.iter().zip(arrivals).enumerate() {
            let offsets: Vec<f64> = age.iter().zip(arrival).map(|(a, b)| (b - a) * 1e-3).collect();
            self.check_offsets(&stream(i), &offsets, findings);
        }
    }

    /// Checks the distance of a stream's stamps from the log's times, in seconds per row.
    fn check_offsets(&self, stream: &str, offsets: &[f64], findings: &mut Vec<Finding>) {
        let bounds = &self.thresholds.time;
        let finite = offsets.iter().enumerate().filter(|(_, o)| o.is_finite());
        let points: Vec<(f64, f64)> = finite.map(|(t, o)| (t as f64 * self.period, *o)).collect();
        if points.len() < 50 {
            return;
        }
        let values: Vec<f64> = points.iter().map(|p| p.1).collect();
        let centre = median(&values);
        if centre.abs() > bounds.offset_secs {
            let message = format!("stamps of stream {stream} are {centre:+.3} s from the log's times");
            findings.push(
                self.finding("TIME-013", "gawm.arrival_age_ms", message)
                    .dim(stream)
                    .measured(centre.abs(), bounds.offset_secs),
            );
        }
        // The slope between the medians of the first and the last fifth: single late messages do not move it.
        let fifth = points.len() / 5;
        let rise = median(&values[values.len() - fifth..]) - median(&values[..fifth]);
        let span = points[points.len() - 1].0 - points[0].0;
        let slope_ppm = rise / (0.8 * span) * 1e6;
        let scatter = quantile(&values, 0.75) - quantile(&values, 0.25);
        if slope_ppm.abs() > bounds.drift_ppm
            && rise.abs() > 2e-3
            && rise.abs() > 0.6 * scatter
            && is_steady(&values, rise)
        {
            let message = format!(
                "the clock of stream {stream} drifts {slope_ppm:+.0} ppm against the log: {:+.1} ms in the episode",
                rise * 1e3
            );
            findings.push(
                self.finding("TIME-012", "gawm.arrival_age_ms", message)
                    .dim(stream)
                    .measured(slope_ppm.abs(), bounds.drift_ppm),
            );
        }
    }

    /// Reports the first stretch and the number of steps for which `is_event` holds.
    #[expect(clippy::too_many_arguments, reason = "one line per rule at the call")]
    fn events(
        &self,
        code: &'static str,
        name: &str,
        steps: &[f64],
        is_event: impl Fn(f64) -> bool,
        what: &str,
        measure: Option<(f64, f64)>,
        findings: &mut Vec<Finding>,
    ) {
        let Some(first) = steps.iter().position(|s| is_event(*s)) else { return };
        let n = steps.iter().filter(|s| is_event(**s)).count();
        let n_rows = steps[first..].iter().take_while(|s| is_event(**s)).count();
        let worst = steps
            .iter()
            .copied()
            .filter(|s| is_event(*s))
            .fold(0.0, |a: f64, s| if s.abs() > a.abs() { s } else { a });
        let size =
            if worst == 0.0 { String::new() } else { format!(", the largest of {:.4} s", worst.abs()) };
        let message = format!("{n} {what} by {name}{size}");
        let (factor, bound) = measure.unwrap_or((0.0, 0.0));
        let measured = if measure.is_some() { worst * factor } else { n as f64 };
        findings.push(
            self.finding(code, name, message).rows(first + 1, first + 1 + n_rows).measured(measured, bound),
        );
    }
}

/// Returns whether the values rise (or fall) in each quarter alike, as drift does and a step does not.
fn is_steady(values: &[f64], rise: f64) -> bool {
    let quarter = values.len() / 4;
    let centres: Vec<f64> = values.chunks(quarter.max(1)).take(4).map(median).collect();
    centres.windows(2).all(|w| (w[1] - w[0]) * rise.signum() > 0.1 * rise.abs())
}
