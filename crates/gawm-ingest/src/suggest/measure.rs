//! Refines a draft by what the values do: wrapped angles, the delay between commands and states.

use std::collections::BTreeMap;
use std::ops::ControlFlow;

use gawm_schema::Wrap;

use super::Suggestion;
use super::commands::{Follower, adopt_kinds};
use super::lag::{Following, Series, following};
use super::survey::Survey;
use crate::contract::{
    ActionTimingSpec, AlignSpec, Clock, KindSpec, ReduceSpec, RoleSpec, StreamSpec, check,
};
use crate::decode::{FieldPath, SchemaLibrary, Segment};
use crate::run::{BindError, Binding, Plans};

/// Samples per stream that are looked at.
const MAX_SAMPLES: usize = 40_000;
/// A correlation below this says nothing.
const MIN_CORRELATION: f64 = 0.7;
/// Correlations that differ by less say the same.
const EQUAL_CORRELATION: f64 = 0.005;
/// Columns of an action that are compared with the state, at most.
const MAX_COLUMNS: usize = 32;

/// Refines kinds and timings.
pub(crate) fn refine(suggestion: &mut Suggestion, survey: &Survey, library: &SchemaLibrary) {
    remove_unbindable(suggestion, survey, library);
    let Some(series) = read(suggestion, survey, library) else { return };
    split_by_wrap(suggestion, &series);
    let Some(series) = read(suggestion, survey, library) else { return };
    time_actions(suggestion, survey, &series);
}

/// The values of one stream, by column.
pub(crate) type StreamSeries = BTreeMap<usize, Vec<Series>>;

/// Drops streams whose fields do not compile after all, with the reason.
fn remove_unbindable(suggestion: &mut Suggestion, survey: &Survey, library: &SchemaLibrary) {
    for _ in 0..suggestion.contract.stream.len() {
        let Ok(checked) = check(&suggestion.contract, "suggestion") else { return };
        let text = match Binding::new(&checked, &survey.first.name, &survey.first.channels, library) {
            Ok(_) => return,
            Err(BindError::Run(error)) => error.to_string(),
            Err(BindError::Refused(refusal)) => refusal.to_string(),
        };
        let is_named =
            |name: &Option<String>| name.as_ref().is_some_and(|name| text.contains(&format!("{name:?}")));
        let Some(at) = checked.streams.iter().position(|stream| is_named(&stream.name)) else { return };
        let stream = suggestion.contract.stream.remove(at);
        suggestion.stream_reasons.remove(at);
        suggestion.unmapped.push(format!("{}: {text}", stream.topic.unwrap_or_default()));
    }
}

/// Reads the values of all vector streams of the first recording.
fn read(suggestion: &Suggestion, survey: &Survey, library: &SchemaLibrary) -> Option<StreamSeries> {
    let checked = check(&suggestion.contract, "suggestion").ok()?;
    let binding = Binding::new(&checked, &survey.first.name, &survey.first.channels, library).ok()?;
    let plans = Plans::new(&binding, &[], &[], library);
    let mut all: StreamSeries = BTreeMap::new();
    let _: ControlFlow<()> = survey.first.read(&plans, 1, |_, block| {
        for message in block.messages.iter().filter(|message| message.loss().is_none()) {
            let topic = &plans.topics[message.topic];
            for (stream, stamp_ns, values) in topic.samples(message.rows(&block.rows), &block.values) {
                let bound = &binding.streams[stream];
                let series =
                    all.entry(bound.rule.index).or_insert_with(|| vec![Series::default(); values.len()]);
                let ns = match bound.rule.clock {
                    Clock::Log => message.log_ns,
                    Clock::Publish => message.publish_ns,
                    _ => stamp_ns.unwrap_or(message.publish_ns),
                };
                let is_next = series[0].times_ns.last().is_none_or(|&last| ns > last);
                if !is_next || series[0].times_ns.len() >= MAX_SAMPLES {
                    continue;
                }
                for (series, &value) in series.iter_mut().zip(values) {
                    series.times_ns.push(ns);
                    series.values.push(value);
                }
            }
        }
        ControlFlow::Continue(())
    });
    Some(all)
}

/// Splits streams of angles where some wrap and others do not.
fn split_by_wrap(suggestion: &mut Suggestion, series: &StreamSeries) {
    let mut streams = Vec::new();
    let mut reasons = Vec::new();
    for (index, stream) in suggestion.contract.stream.iter().enumerate() {
        let own = &suggestion.stream_reasons[index];
        let wraps: Vec<Wrap> = match series.get(&index) {
            Some(columns) if stream.kind == KindSpec::Angle && columns.len() == stream.fields.len() => {
                columns.iter().map(|column| wrap_of(&column.values)).collect()
            }
            _ => vec![Wrap::None; stream.fields.len().max(1)],
        };
        let mut at = 0;
        while at < wraps.len() {
            let n = wraps[at..].iter().take_while(|wrap| **wrap == wraps[at]).count();
            let mut part = stream.clone();
            let mut why = own.clone();
            if n < wraps.len() {
                part.fields = stream.fields[at..at + n].to_vec();
                if stream.limits.len() == wraps.len() {
                    part.limits = stream.limits[at..at + n].to_vec();
                }
            }
            if wraps[at] != Wrap::None {
                part.wrap = Some(wraps[at]);
                why.push("wrap: the value jumps by a turn between samples".to_owned());
            }
            streams.push(part);
            reasons.push(why);
            at += n;
        }
    }
    suggestion.contract.stream = streams;
    suggestion.stream_reasons = reasons;
}

/// Returns the interval that angles are wrapped to: told by jumps of nearly a turn.
pub(crate) fn wrap_of(values: &[f64]) -> Wrap {
    use std::f64::consts::PI;
    let has_jump = values.windows(2).any(|pair| ((pair[1] - pair[0]).abs() - 2.0 * PI).abs() < 1.0);
    let (low, high) =
        values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
    match has_jump {
        false => Wrap::None,
        true if low >= -1e-6 && high <= 2.0 * PI + 1e-3 => Wrap::TwoPi,
        true if low >= -PI - 1e-3 && high <= PI + 1e-3 => Wrap::Pi,
        true => Wrap::None,
    }
}

fn time_actions(suggestion: &mut Suggestion, survey: &Survey, series: &StreamSeries) {
    let streams = &suggestion.contract.stream;
    let places: Vec<(Place, Option<String>)> = series
        .iter()
        .filter(|(index, _)| streams[**index].role != Some(RoleSpec::Action))
        .flat_map(|(&index, columns)| (0..columns.len()).map(move |at| (index, at, columns.len())))
        .map(|(index, at, n)| ((index, at), element_name(&streams[index], n, at)))
        .collect();
    let kinds: Vec<(KindSpec, Option<Wrap>, Option<String>)> = suggestion
        .contract
        .stream
        .iter()
        .map(|stream| (stream.kind, stream.wrap, stream.unit.clone()))
        .collect();
    let tick_hz = suggestion.contract.ticks.rate_hz.unwrap_or(10.0);
    let mut followers: BTreeMap<usize, Vec<Option<Follower>>> = BTreeMap::new();
    // The values of a message act at the same time, whichever streams they were shared out to.
    let mut lags_of: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for (index, stream) in suggestion.contract.stream.iter().enumerate() {
        let Some(topic) = stream.topic.clone().filter(|_| stream.role == Some(RoleSpec::Action)) else {
            continue;
        };
        let columns = series.get(&index).map_or(&[][..], Vec::as_slice);
        let follower = |at: usize| {
            let name = element_name(stream, columns.len(), at);
            let own: Vec<Place> = places
                .iter()
                .filter(|(_, other)| name.is_some() && *other == name)
                .map(|(place, _)| *place)
                .collect();
            // What has the name of the command is what it moves, whatever moves like it.
            let among = if own.is_empty() { places.iter().map(|(place, _)| *place).collect() } else { own };
            best_state(&columns[at], &among, series)
        };
        let is_measured = |at: usize| at < MAX_COLUMNS && stream.kind != KindSpec::Bool;
        let followed: Vec<Option<Follower>> =
            (0..columns.len()).map(|at| is_measured(at).then(|| follower(at)).flatten()).collect();
        let lags = followed.iter().flatten().map(|follower| follower.following.lag_s * 1e3);
        lags_of.entry(topic).or_default().extend(lags);
        followers.insert(index, followed);
    }
    for (&index, followed) in &followers {
        let stream = &mut suggestion.contract.stream[index];
        let topic = stream.topic.clone().unwrap_or_default();
        let found: Vec<(usize, Following)> =
            followed.iter().flatten().map(|follower| (follower.stream, follower.following)).collect();
        let measured = Measured {
            found: &found,
            n_columns: followed.len(),
            lags_ms: lags_of.get(&topic).map_or(&[][..], Vec::as_slice),
            rate_hz: survey.topics.get(&topic).map_or(0.0, super::survey::Topic::rate_hz),
            tick_hz,
        };
        apply(stream, &mut suggestion.stream_reasons[index], &measured, &kinds);
    }
    followers.retain(|index, followed| {
        is_position(&suggestion.contract.stream[*index], followed) && followed.len() <= MAX_COLUMNS
    });
    adopt_kinds(suggestion, &followers, series);
}

/// What was measured of a command.
struct Measured<'a> {
    /// State streams that follow its columns, and how.
    found: &'a [(usize, Following)],
    n_columns: usize,
    /// Delays of all columns of its topic.
    lags_ms: &'a [f64],
    /// Commands per second.
    rate_hz: f64,
    /// Rows per second.
    tick_hz: f64,
}

fn is_velocity(stream: &StreamSpec, n_velocity: usize, n_found: usize) -> bool {
    let name = stream.topic.as_deref().unwrap_or_default();
    !super::names::is_delta(name)
        && (2 * n_velocity > n_found || (n_found == 0 && super::names::is_velocity(name)))
}

/// Returns whether a command may be one of positions: neither of steps nor of velocities.
fn is_position(stream: &StreamSpec, followed: &[Option<Follower>]) -> bool {
    let found = followed.iter().flatten();
    let n_velocity = found.clone().filter(|follower| follower.following.is_velocity).count();
    !super::names::is_delta(stream.topic.as_deref().unwrap_or_default())
        && !is_velocity(stream, n_velocity, found.count())
}

/// A state column: index of its stream, and its place there.
type Place = (usize, usize);

/// Returns the name that picks a column out of its message, as that of a joint does.
fn element_name(stream: &StreamSpec, n_columns: usize, at: usize) -> Option<String> {
    let field = stream.fields.get(at).filter(|_| stream.fields.len() == n_columns)?;
    let path: FieldPath = field.parse().ok()?;
    path.segments().iter().rev().find_map(|segment| match segment {
        Segment::Key { value, .. } => Some(value.clone()),
        _ => None,
    })
}

/// Returns the state column that follows a command best; of those that do so equally well, as the legs of a gait do,
/// the one that follows soonest.
fn best_state(command: &Series, places: &[Place], series: &StreamSeries) -> Option<Follower> {
    let found: Vec<Follower> = places
        .iter()
        .filter_map(|&(stream, column)| {
            let following = following(command, series.get(&stream)?.get(column)?)?;
            Some(Follower { stream, column, following })
        })
        .collect();
    let highest = found.iter().map(|found| found.following.correlation).fold(f64::NEG_INFINITY, f64::max);
    let equal = found.into_iter().filter(|found| found.following.correlation >= highest - EQUAL_CORRELATION);
    equal
        .min_by(|a, b| a.following.lag_s.total_cmp(&b.following.lag_s))
        .filter(|best| best.following.correlation >= MIN_CORRELATION)
}

/// Returns the upper median; 0 of nothing.
fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

/// Sets offset and timing.
fn apply(
    stream: &mut StreamSpec,
    reasons: &mut Vec<String>,
    measured: &Measured<'_>,
    kinds: &[(KindSpec, Option<Wrap>, Option<String>)],
) {
    let Measured { found, n_columns, rate_hz, tick_hz, .. } = *measured;
    let commands_per_tick = rate_hz / tick_hz;
    let is_delta = super::names::is_delta(stream.topic.as_deref().unwrap_or_default());
    let n_velocity = found.iter().filter(|(_, following)| following.is_velocity).count();
    let is_velocity = is_velocity(stream, n_velocity, found.len());
    let is_told = 2 * found.len() >= n_columns.max(1);
    if is_told {
        // A step acts over the period after its command, so what is measured is later by half a period.
        let half_ms = if is_delta && rate_hz > 0.0 { 500.0 / rate_hz } else { 0.0 };
        let lag_ms = (median(measured.lags_ms) - half_ms).max(0.0);
        let correlation = found.iter().map(|(_, f)| f.correlation).fold(f64::INFINITY, f64::min);
        let what = if is_delta {
            "step"
        } else if is_velocity {
            "velocity"
        } else {
            "position"
        };
        stream.offset_ms = if lag_ms >= 1.0 { (lag_ms * 10.0).round() / 10.0 } else { 0.0 };
        reasons.push(format!(
            "offset: the state follows this {what} command after {lag_ms:.1} ms (correlation of {} of {n_columns} columns at least {correlation:.2}), so it acts that much later",
            found.len()
        ));
    } else if stream.kind == KindSpec::Bool && !measured.lags_ms.is_empty() {
        let lag_ms = median(measured.lags_ms);
        stream.offset_ms = if lag_ms >= 1.0 { (lag_ms * 10.0).round() / 10.0 } else { 0.0 };
        reasons.push("offset: that of the other values of its message".to_owned());
    } else {
        reasons.push(
            "offset: no clear delay between this command and the state; 0 until you know better".to_owned(),
        );
    }
    if is_velocity && stream.unit.is_none() && stream.kind == KindSpec::Linear && is_told {
        let state = found.first().map(|(state, _)| &kinds[*state]);
        if let Some((KindSpec::Angle, ..)) = state {
            stream.unit = Some("rad/s".to_owned());
            reasons.push("unit: the velocity of joint angles".to_owned());
        }
    }
    let Some(action) = &mut stream.action else { return };
    if commands_per_tick >= 1.5 {
        action.timing = ActionTimingSpec::Window;
        let reduce = match (is_delta, is_velocity, stream.kind) {
            (true, _, KindSpec::Rotvec | KindSpec::Quaternion | KindSpec::Matrix | KindSpec::Euler) => {
                ReduceSpec::Compose
            }
            (true, ..) => ReduceSpec::Sum,
            (false, true, KindSpec::Linear | KindSpec::Angle) => ReduceSpec::Mean,
            _ => ReduceSpec::Last,
        };
        action.reduce = Some(reduce);
        reasons.push(format!("timing: {commands_per_tick:.1} commands per row become one"));
        if stream.align == Some(AlignSpec::Hold) && stream.tolerance_ms.is_none() && is_delta {
            reasons.push("a row without a command ends the episode: steps cannot be held".to_owned());
        }
    } else {
        reasons.push("timing: at most about one command per row: the one in force".to_owned());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wraps_are_told_by_jumps() {
        assert_eq!(wrap_of(&[3.0, 3.1, -3.1, -3.0]), Wrap::Pi);
        assert_eq!(wrap_of(&[6.0, 6.2, 0.1, 0.3]), Wrap::TwoPi);
        assert_eq!(wrap_of(&[0.0, 1.0, 2.0]), Wrap::None);
        assert_eq!(wrap_of(&[3.0, 9.3, 3.1]), Wrap::None);
    }
}
