//! What the columns of a position command are: told by the state columns that follow them.

use std::collections::BTreeMap;

use gawm_schema::Wrap;

use super::Suggestion;
use super::lag::{Following, Series};
use super::measure::{StreamSeries, wrap_of};
use crate::contract::{KindSpec, RoleSpec, StreamSpec};
use crate::decode::{FieldPath, Segment};

/// A command and the state that follows it have the same scale when the ratio of their spreads is within this of 1.
const SCALE_SLACK: f64 = 1.5;
/// A command may lie this far outside of what its joint was seen at, in rad.
const RANGE_SLACK_RAD: f64 = 0.5;

/// The state column that follows a column of a command.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Follower {
    /// Index of the state's stream.
    pub(crate) stream: usize,
    /// Its column there.
    pub(crate) column: usize,
    pub(crate) following: Following,
}

/// What one column of a command was found to be.
#[derive(Debug, Clone, PartialEq)]
struct Found {
    kind: KindSpec,
    unit: Option<String>,
    wrap: Option<Wrap>,
    reason: String,
}

/// Gives the columns of position commands the kinds of the state columns that follow them; splits streams where the
/// columns differ. `followers` holds one entry per column, by stream.
pub(crate) fn adopt_kinds(
    suggestion: &mut Suggestion,
    followers: &BTreeMap<usize, Vec<Option<Follower>>>,
    series: &StreamSeries,
) {
    let joints = joints_of(suggestion);
    let streams = std::mem::take(&mut suggestion.contract.stream);
    let all_reasons = std::mem::take(&mut suggestion.stream_reasons);
    let (mut kept, mut kept_reasons) = (Vec::new(), Vec::new());
    for (index, (stream, reasons)) in streams.iter().zip(all_reasons).enumerate() {
        let columns = series.get(&index).map_or(&[][..], Vec::as_slice);
        let found = match followers.get(&index) {
            Some(followers) if is_plain_command(stream) => {
                kinds_of(followers, columns, &joints, &streams, series)
            }
            _ => Vec::new(),
        };
        for (part, mut why) in parts_of(stream, &found, columns) {
            let mut all = reasons.clone();
            all.append(&mut why);
            kept.push(part);
            kept_reasons.push(all);
        }
    }
    suggestion.contract.stream = kept;
    suggestion.stream_reasons = kept_reasons;
}

/// A command whose name and type say nothing of what its numbers are.
fn is_plain_command(stream: &StreamSpec) -> bool {
    stream.role == Some(RoleSpec::Action) && stream.kind == KindSpec::Linear && stream.unit.is_none()
}

/// A state column: index of its stream, and its place there.
type Place = (usize, usize);

/// Returns the joints of each topic of joint angles, in the order of the contract.
fn joints_of(suggestion: &Suggestion) -> BTreeMap<String, Vec<Place>> {
    let mut joints: BTreeMap<String, Vec<Place>> = BTreeMap::new();
    for (index, stream) in suggestion.contract.stream.iter().enumerate() {
        if stream.role == Some(RoleSpec::State)
            && let Some(topic) = &stream.topic
        {
            joints.entry(topic.clone()).or_default().extend((0..stream.fields.len()).map(|at| (index, at)));
        }
    }
    joints.retain(|_, places| {
        places.iter().any(|(stream, _)| suggestion.contract.stream[*stream].kind == KindSpec::Angle)
    });
    joints
}

fn kinds_of(
    followers: &[Option<Follower>],
    columns: &[Series],
    joints: &BTreeMap<String, Vec<Place>>,
    streams: &[StreamSpec],
    series: &StreamSeries,
) -> Vec<Option<Found>> {
    let mut found: Vec<Option<Found>> = followers
        .iter()
        .zip(columns)
        .map(|(follower, column)| follower.and_then(|follower| followed(follower, column, streams, series)))
        .collect();
    // What does not move is followed by nothing; its place tells, if the others are in theirs. A command may go on
    // behind the joints, with a gripper.
    let is_in_place = |places: &&Vec<Place>| {
        places.len() <= columns.len()
            && followers.iter().zip(places.iter()).all(|(follower, place)| {
                follower.is_none_or(|follower| (follower.stream, follower.column) == *place)
            })
            && places.iter().zip(columns).all(|(place, column)| is_near(column, place, series))
    };
    let mut fitting = joints.values().filter(is_in_place);
    if let (Some(places), None) = (fitting.next(), fitting.next()) {
        for ((found, place), column) in found.iter_mut().zip(places).zip(columns) {
            if found.is_none() {
                *found = Some(placed(&streams[place.0], column, streams[place.0].topic.as_deref()));
            }
        }
    }
    found
}

/// What a column is by the state column that follows it, if their scales agree.
fn followed(
    follower: Follower,
    column: &Series,
    streams: &[StreamSpec],
    series: &StreamSeries,
) -> Option<Found> {
    let state = &streams[follower.stream];
    let ratio = spread(column) / spread(series.get(&follower.stream)?.get(follower.column)?);
    let is_scale = |scale: f64| (ratio / scale).max(scale / ratio) <= SCALE_SLACK;
    let correlation = follower.following.correlation;
    match state.kind {
        KindSpec::Angle if is_scale(1.0) => Some(Found {
            kind: KindSpec::Angle,
            unit: state.unit.clone(),
            wrap: Some(wrap_of(&column.values)).filter(|wrap| *wrap != Wrap::None),
            reason: format!(
                "joint angles follow these columns, on the same scale (correlation {correlation:.2}): angles too"
            ),
        }),
        KindSpec::Angle if is_scale(180.0 / std::f64::consts::PI) => Some(Found {
            kind: KindSpec::Angle,
            unit: Some("deg".to_owned()),
            wrap: None,
            reason: format!(
                "joint angles in rad follow these columns, on 180/pi times their scale (correlation {correlation:.2}): angles in degrees"
            ),
        }),
        KindSpec::Gripper if is_scale(1.0) => Some(Found {
            kind: KindSpec::Gripper,
            unit: state.unit.clone(),
            wrap: None,
            reason: format!(
                "a gripper follows these columns, on the same scale (correlation {correlation:.2})"
            ),
        }),
        _ => None,
    }
}

/// What a column is by the joint of its place.
fn placed(state: &StreamSpec, column: &Series, topic: Option<&str>) -> Found {
    let wrap = match state.kind {
        KindSpec::Angle => Some(wrap_of(&column.values)).filter(|wrap| *wrap != Wrap::None),
        _ => None,
    };
    Found {
        kind: state.kind,
        unit: state.unit.clone(),
        wrap,
        reason: format!(
            "values in the order of the joints of {}, each near the joint of its place: taken for the same quantity",
            topic.unwrap_or_default()
        ),
    }
}

fn is_near(column: &Series, place: &Place, series: &StreamSeries) -> bool {
    let Some(state) = series.get(&place.0).and_then(|columns| columns.get(place.1)) else { return false };
    let ((low, high), (state_low, state_high)) = (range(column), range(state));
    low >= state_low - RANGE_SLACK_RAD && high <= state_high + RANGE_SLACK_RAD
}

fn range(series: &Series) -> (f64, f64) {
    let finite = series.values.iter().filter(|value| value.is_finite());
    finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(*value), high.max(*value)))
}

/// Standard deviation of the finite values.
fn spread(series: &Series) -> f64 {
    let finite = || series.values.iter().copied().filter(|value| value.is_finite());
    let n = finite().count().max(1) as f64;
    let mean = finite().sum::<f64>() / n;
    (finite().map(|value| (value - mean) * (value - mean)).sum::<f64>() / n).sqrt()
}

/// Cuts a stream into runs of columns that were found to be the same; each with the reasons to add.
fn parts_of(
    stream: &StreamSpec,
    found: &[Option<Found>],
    columns: &[Series],
) -> Vec<(StreamSpec, Vec<String>)> {
    let same = |a: &Option<Found>, b: &Option<Found>| match (a, b) {
        (Some(a), Some(b)) => (a.kind, &a.unit, a.wrap) == (b.kind, &b.unit, b.wrap),
        (None, None) => true,
        _ => false,
    };
    let is_uniform = found.windows(2).all(|pair| same(&pair[0], &pair[1]));
    let fields = single_fields(&stream.fields, columns.len());
    let mut parts = Vec::new();
    let mut at = 0;
    while at < found.len() {
        let n = found[at..].iter().take_while(|other| same(other, &found[at])).count();
        let mut part = stream.clone();
        let mut why = Vec::new();
        match &fields {
            _ if is_uniform => {}
            Some(fields) => part.fields = joined(&fields[at..at + n]),
            // Its columns cannot be told apart by path.
            None => return vec![(stream.clone(), Vec::new())],
        }
        match &found[at] {
            Some(found) => {
                part.kind = found.kind;
                part.unit.clone_from(&found.unit);
                part.wrap = found.wrap;
                why.push(format!("kind: {}", found.reason));
            }
            None if !is_uniform => why.push("kind: no state follows these columns: left linear".to_owned()),
            None => {}
        }
        parts.push((part, why));
        at += n;
    }
    if parts.is_empty() { vec![(stream.clone(), Vec::new())] } else { parts }
}

/// Returns one path per column, if the paths tell how many each has.
fn single_fields(fields: &[String], n_columns: usize) -> Option<Vec<FieldPath>> {
    let mut single = Vec::new();
    for field in fields {
        let path: FieldPath = field.parse().ok()?;
        let (last, before) = path.segments().split_last()?;
        match last {
            Segment::Slice { start, end: Some(end) } => single.extend((*start..*end).map(|element| {
                let index = Segment::Index(i64::from(element));
                FieldPath::from_segments(before.iter().cloned().chain([index]).collect())
            })),
            _ => single.push(path),
        }
    }
    (single.len() == n_columns).then_some(single)
}

/// Returns paths with runs of elements of an array as slices.
fn joined(paths: &[FieldPath]) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    let mut at = 0;
    while at < paths.len() {
        let element = |path: &FieldPath| match path.segments().split_last() {
            Some((Segment::Index(index), before)) => Some((before.to_vec(), u32::try_from(*index).ok()?)),
            _ => None,
        };
        let Some((base, start)) = element(&paths[at]) else {
            out.push(paths[at].to_string());
            at += 1;
            continue;
        };
        let n = (1..)
            .zip(&paths[at + 1..])
            .take_while(|(k, path)| element(path).is_some_and(|(other, i)| other == base && i == start + k))
            .count() as u32
            + 1;
        let last = if n == 1 {
            Segment::Index(i64::from(start))
        } else {
            Segment::Slice { start, end: Some(start + n) }
        };
        out.push(FieldPath::from_segments(base.into_iter().chain([last]).collect()).to_string());
        at += n as usize;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_joined(fields: &[&str], columns: usize, expected: &[&str]) {
        let fields: Vec<String> = fields.iter().map(|field| (*field).to_owned()).collect();
        let single = single_fields(&fields, columns).unwrap();
        assert_eq!(single.len(), columns);
        assert_eq!(joined(&single), expected);
    }

    #[test]
    fn slices_come_apart_and_together() {
        check_joined(&["data[0:7]"], 7, &["data[0:7]"]);
        check_joined(&["a.b[2:4]", "x", "c[1]", "c[2]"], 5, &["a.b[2:4]", "x", "c[1:3]"]);
        check_joined(&["c[3]", "c[5]"], 2, &["c[3]", "c[5]"]);
        assert_eq!(single_fields(&["data[:]".to_owned()], 7), None);
    }
}
