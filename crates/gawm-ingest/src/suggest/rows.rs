//! A first contract for files whose columns have names and no times: HDF5, npz, LeRobot.

use super::Suggestion;
use crate::contract::{
    ActionSpec, ActionTimingSpec, DeltaFrame, GapRule, KindSpec, LabelSource, MetadataLabel, NonFiniteRule,
    RoleSpec, StreamSpec, TickMode,
};
use crate::lerobot::LerobotRecording;
use crate::rows::{RowRecording as _, Unavailable};
use crate::tabular::{Dtype, Layout, TableReport};

/// One column as far as a guess needs it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct NamedColumn {
    pub(crate) name: String,
    /// Values per row; 0 for images and texts.
    pub(crate) width: usize,
    pub(crate) is_image: bool,
    /// Whether a row is a list, be it of one value.
    pub(crate) is_list: bool,
    /// Names of the values, where the file gives them.
    pub(crate) names: Vec<String>,
    /// What a column that is no vector and no image is.
    pub(crate) what: &'static str,
}

/// Names of the action, the best first.
const ACTIONS: [&str; 4] = ["action", "actions", "action_sequence", "act"];
/// Names of the state, the best first.
const STATES: [&str; 11] = [
    "observation.state",
    "proprio",
    "state",
    "obs_state",
    "observation",
    "observations",
    "joint_pos",
    "joint_positions",
    "qpos",
    "obs",
    "observations/state",
];
/// Groups whose columns are observations.
const GROUPS: [&str; 3] = ["obs/", "observations/", "observation/"];
/// The state where there is nothing else: robomimic and LIBERO keep that of the whole simulator under this name.
const LAST_STATE: &str = "states";
/// Beginnings of groups and columns that repeat the observations of the next row.
const NEXT_ROW: &str = "next_";
/// Widest column that is proposed: wider ones are rarely states.
const MAX_WIDTH: usize = 256;

/// Suggests a contract for a table.
pub(crate) fn of_table(report: &TableReport) -> Suggestion {
    let columns = report.columns.iter().filter(|column| column.extent.is_some_and(|e| e.has_steps()));
    let columns: Vec<NamedColumn> = columns
        .map(|column| NamedColumn {
            name: column.name.clone(),
            is_image: is_image(column.dtype, &column.row_shape),
            is_list: !column.row_shape.is_empty(),
            width: match column.dtype.is_number() {
                true => usize::try_from(column.row_shape.iter().product::<u64>()).unwrap_or(usize::MAX),
                false => 0,
            },
            names: Vec::new(),
            what: "text",
        })
        .collect();
    let mut suggestion = of_columns(&columns, 10);
    suggestion.unmapped.extend(not_offered(report));
    let reasons = vec![
        "the file holds no times: 10 rows a second are assumed; write the rate of the recording".to_owned(),
    ];
    suggestion.reasons.insert("ticks", reasons);
    let layout = report.layout.as_ref().map_or("unknown", |layout| layout.name());
    let reason = match report.layout {
        Some(Layout::Single { .. }) => {
            format!(
                "nothing in the file marks episodes: each file is one, this one with {} rows",
                report.steps
            )
        }
        _ => format!(
            "the file lists its episodes itself (layout {layout:?}): {} with {} rows",
            report.episodes, report.steps
        ),
    };
    suggestion.reasons.insert("episodes", vec![reason]);
    suggestion
}

/// Columns that no stream can have, and why.
fn not_offered(report: &TableReport) -> Vec<String> {
    let rows = report.columns.iter().filter(|column| column.extent.is_none_or(|e| !e.has_steps()));
    let rows = rows.filter_map(|column| {
        let rows = column.rows?;
        (rows > 1).then(|| format!("{}: {rows} rows, which are not those of the episode", column.name))
    });
    let unreadable = report
        .others
        .iter()
        .filter_map(|column| column.problem.as_ref().map(|problem| format!("{}: {problem}", column.name)));
    rows.chain(unreadable).collect()
}

/// Suggests a contract for a LeRobot folder.
pub(crate) fn of_lerobot(recording: &LerobotRecording) -> Suggestion {
    let info = &recording.dataset().info;
    let columns: Vec<NamedColumn> = recording
        .channels()
        .iter()
        .map(|channel| {
            let declared = info.feature(&channel.topic);
            let schema = channel.schema.as_deref();
            let has = |text: &str| {
                schema.is_some_and(|schema| String::from_utf8_lossy(&schema.data).contains(text))
            };
            let is_image = schema.is_some_and(|schema| schema.name.ends_with("Image"));
            let (is_list, is_text) = (has("[] data"), has("string data"));
            let is_number = declared.map_or(!is_list && !is_text, |feature| feature.is_numeric());
            let width = declared.map_or(1, |feature| feature.width());
            let names = declared.map(|feature| feature.names.clone()).unwrap_or_default();
            NamedColumn {
                name: channel.topic.clone(),
                is_image,
                is_list,
                width: if is_number && !is_image { width } else { 0 },
                names: if names.len() == width { names } else { Vec::new() },
                what: if is_text { "text" } else { "not declared as numbers in meta/info.json" },
            }
        })
        .chain(recording.unavailable().iter().filter(is_undecoded_video).map(|video| NamedColumn {
            name: video.topic.clone(),
            width: 0,
            is_image: true,
            is_list: false,
            names: Vec::new(),
            what: "video",
        }))
        .collect();
    let fps = info.fps.round().clamp(1.0, 100_000.0) as u32;
    let mut suggestion = of_columns(&columns, fps);
    suggestion.contract.robot_type.clone_from(&info.robot_type);
    suggestion.reasons.insert("ticks", vec![format!("fps of meta/info.json: {}", info.fps)]);
    let (episodes, rows) = recording.counts();
    suggestion.reasons.insert(
        "episodes",
        vec![format!("the dataset lists its episodes itself: {episodes} with {rows} rows in the data")],
    );
    let has = |key: &str| recording.metadata().iter().any(|record| record.values.contains_key(key));
    let label = |key: &str| {
        has(key).then(|| {
            LabelSource::Metadata(MetadataLabel { metadata: "episode".to_owned(), key: key.to_owned() })
        })
    };
    let labels = &mut suggestion.contract.labels;
    labels.task = label("task");
    labels.success = label("success");
    labels.operator = label("operator");
    labels.robot = label("robot");
    labels.session = label("session");
    for video in recording.unavailable().iter().filter(is_undecoded_video) {
        for (stream, reasons) in suggestion.contract.stream.iter().zip(&mut suggestion.stream_reasons) {
            if stream.topic.as_ref() == Some(&video.topic) {
                reasons.push(format!("{}: the run leaves it out; {}", video.detail, video.hint));
            }
        }
    }
    for absent in recording.unavailable().iter().filter(|absent| !is_undecoded_video(absent)) {
        suggestion.unmapped.push(format!("{}: {}", absent.topic, absent.detail));
    }
    suggestion
}

/// Whether a feature has videos that this build does not decode: a contract keeps it for a build that does.
fn is_undecoded_video(absent: &&Unavailable) -> bool {
    absent.reason == "video_not_decoded"
}

fn is_image(dtype: Dtype, row_shape: &[u64]) -> bool {
    dtype == Dtype::U8 && matches!(row_shape, &[h, w, 1 | 3 | 4] if h > 1 && w > 1)
}

fn of_columns(columns: &[NamedColumn], fps: u32) -> Suggestion {
    let mut suggestion = Suggestion::default();
    suggestion.contract.ticks.mode = TickMode::Native;
    suggestion.contract.ticks.fps = Some(fps);
    let is_vector = |column: &&NamedColumn| (1..=MAX_WIDTH).contains(&column.width) && !column.is_image;
    let find = |wanted: &[&str]| {
        wanted.iter().find_map(|name| columns.iter().filter(is_vector).find(|c| c.name == *name))
    };
    let action = find(&ACTIONS);
    let grouped: Vec<&NamedColumn> = columns
        .iter()
        .filter(is_vector)
        .filter(|column| GROUPS.iter().any(|group| column.name.starts_with(group)))
        .collect();
    let states = match find(&STATES) {
        Some(state) => vec![state],
        None if grouped.is_empty() => find(&[LAST_STATE]).into_iter().collect(),
        None => grouped,
    };
    let period_ms = 1000.0 / f64::from(fps);
    // Rows lie one period apart; a little more, so that rounding is no gap.
    let tolerance_ms = (period_ms * 1.5 * 1000.0).round() / 1000.0;
    for state in &states {
        let mut stream = stream_of(state, "observation.state", tolerance_ms);
        if states.len() > 1 && stream.names.is_empty() {
            stream.names = numbered_names(state);
        }
        stream.role = Some(RoleSpec::State);
        push(&mut suggestion, stream, state, "the state, by its name; state units and kinds (angles!) here");
    }
    if let Some(action) = action {
        let mut stream = stream_of(action, "action", tolerance_ms);
        stream.action = Some(ActionSpec {
            timing: ActionTimingSpec::InForce,
            n: None,
            reduce: None,
            delta_frame: DeltaFrame::Base,
            from: None,
            derived: None,
        });
        push(&mut suggestion, stream, action, "the action of a row acts until the next one");
    }
    let images: Vec<&NamedColumn> =
        columns.iter().filter(|column| column.is_image && !column.name.starts_with(NEXT_ROW)).collect();
    for image in &images {
        let is_only =
            images.iter().filter(|other| last_name(&other.name) == last_name(&image.name)).count() == 1;
        let name = if is_only { last_name(&image.name).to_owned() } else { image.name.replace('/', ".") };
        let feature = match image.name.starts_with("observation.images.") {
            true => image.name.clone(),
            false => format!("observation.images.{name}"),
        };
        // The frame of the row before is no frame of this one.
        let tolerance_ms = (period_ms * 0.5 * 1000.0).round() / 1000.0;
        push(&mut suggestion, stream_of(image, &feature, tolerance_ms), image, "images");
    }
    let used: Vec<Option<String>> =
        suggestion.contract.stream.iter().map(|stream| stream.topic.clone()).collect();
    for column in columns.iter().filter(|column| !used.contains(&Some(column.name.clone()))) {
        let what = match column.width {
            _ if column.is_image => "images of the next row".to_owned(),
            0 => column.what.to_owned(),
            1 => "1 value".to_owned(),
            n if n > MAX_WIDTH => format!("{n} values: more than a state usually has"),
            n => format!("{n} values"),
        };
        suggestion.unmapped.push(format!("{}: {what}", column.name));
    }
    suggestion
}

/// The end of a name: that of the column in its group.
fn last_name(name: &str) -> &str {
    name.rsplit(['/', '.']).next().unwrap_or(name)
}

/// Names for the values of a column that shares a feature with others.
fn numbered_names(column: &NamedColumn) -> Vec<String> {
    let name = last_name(&column.name);
    match column.width {
        1 => vec![name.to_owned()],
        width => (0..width).map(|index| format!("{name}_{index}")).collect(),
    }
}

fn push(suggestion: &mut Suggestion, stream: StreamSpec, column: &NamedColumn, reason: &str) {
    let shown = match (column.is_image, column.width) {
        (true, _) => format!("{}: {reason}", column.name),
        (_, 1) => format!("{}: 1 value; {reason}", column.name),
        (_, n) => format!("{}: {n} values; {reason}", column.name),
    };
    suggestion.contract.stream.push(stream);
    suggestion.stream_reasons.push(vec![shown]);
}

fn stream_of(column: &NamedColumn, feature: &str, tolerance_ms: f64) -> StreamSpec {
    let fields = match (column.is_image, column.is_list) {
        (true, _) => Vec::new(),
        (_, false) => vec!["data".to_owned()],
        (_, true) => vec![format!("data[0:{}]", column.width)],
    };
    StreamSpec {
        name: None,
        topic: Some(column.name.clone()),
        fields,
        feature: feature.to_owned(),
        role: None,
        clock: "stamp".to_owned(),
        align: None,
        tolerance_ms: Some(tolerance_ms),
        offset_ms: 0.0,
        gap: GapRule::Split,
        non_finite: NonFiniteRule::Mask,
        unit: None,
        kind: KindSpec::Linear,
        order: None,
        wrap: None,
        sequence: None,
        frame: None,
        limits: Vec::new(),
        names: column.names.clone(),
        action: None,
        image: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vector(name: &str, width: usize) -> NamedColumn {
        let name = name.to_owned();
        NamedColumn { name, width, is_image: false, is_list: true, names: Vec::new(), what: "text" }
    }

    fn image(name: &str) -> NamedColumn {
        NamedColumn { is_image: true, ..vector(name, 0) }
    }

    /// Each stream as `topic > feature`, then what is not mapped.
    fn mapped(columns: &[NamedColumn]) -> (Vec<String>, Vec<String>) {
        let suggestion = of_columns(columns, 10);
        let streams = suggestion.contract.stream.iter();
        let shown = |s: &StreamSpec| format!("{} > {}", s.topic.as_deref().unwrap_or_default(), s.feature);
        (streams.map(shown).collect(), suggestion.unmapped)
    }

    #[test]
    fn groups_of_robomimic_give_their_observations_and_nothing_of_the_next_row() {
        let columns = [
            vector("actions", 7),
            image("next_obs/agentview_image"),
            vector("next_obs/eef_pos", 3),
            image("obs/agentview_image"),
            vector("obs/eef_pos", 3),
            vector("obs/gripper", 1),
            vector("states", 32),
        ];
        let (streams, unmapped) = mapped(&columns);
        assert_eq!(
            streams,
            [
                "obs/eef_pos > observation.state",
                "obs/gripper > observation.state",
                "actions > action",
                "obs/agentview_image > observation.images.agentview_image"
            ]
        );
        assert_eq!(
            unmapped,
            [
                "next_obs/agentview_image: images of the next row",
                "next_obs/eef_pos: 3 values",
                "states: 32 values"
            ]
        );
        let streams = of_columns(&columns, 10).contract.stream;
        assert_eq!(streams[0].names, ["eef_pos_0", "eef_pos_1", "eef_pos_2"]);
        assert_eq!(streams[1].names, ["gripper"]);
    }

    #[test]
    fn the_state_of_the_simulator_is_the_last_resort() {
        let (streams, _) = mapped(&[vector("actions", 6), vector("states", 14)]);
        assert_eq!(streams, ["states > observation.state", "actions > action"]);
    }

    #[test]
    fn every_camera_gets_a_feature_of_its_own() {
        let (streams, _) = mapped(&[image("left/rgb"), image("right/rgb"), image("top")]);
        assert_eq!(
            streams,
            [
                "left/rgb > observation.images.left.rgb",
                "right/rgb > observation.images.right.rgb",
                "top > observation.images.top"
            ]
        );
        let (streams, _) = mapped(&[image("observation.images.a.rgb"), image("observation.images.b.rgb")]);
        assert_eq!(
            streams,
            [
                "observation.images.a.rgb > observation.images.a.rgb",
                "observation.images.b.rgb > observation.images.b.rgb"
            ]
        );
    }

    #[test]
    fn what_is_not_mapped_says_what_it_is() {
        let declared = NamedColumn { what: "not declared as numbers in meta/info.json", ..vector("odd", 0) };
        let (_, unmapped) = mapped(&[vector("note", 0), declared, vector("wide", 5000)]);
        assert_eq!(
            unmapped,
            [
                "note: text",
                "odd: not declared as numbers in meta/info.json",
                "wide: 5000 values: more than a state usually has"
            ]
        );
    }
}
