//! A first contract for files whose columns have names and no times: HDF5, npz, LeRobot.

use super::Suggestion;
use crate::contract::{
    ActionSpec, ActionTimingSpec, DeltaFrame, GapRule, KindSpec, LabelSource, MetadataLabel, NonFiniteRule,
    RoleSpec, StreamSpec, TickMode,
};
use crate::lerobot::LerobotRecording;
use crate::rows::RowRecording as _;
use crate::tabular::{Dtype, TableReport};

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
}

/// Names of the action, the best first.
const ACTIONS: [&str; 4] = ["action", "actions", "action_sequence", "act"];
/// Names of the state, the best first.
const STATES: [&str; 12] = [
    "observation.state",
    "proprio",
    "state",
    "states",
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
        })
        .collect();
    let mut suggestion = of_columns(&columns, 10);
    let reasons = vec![
        "the file holds no times: 10 rows a second are assumed; write the rate of the recording".to_owned(),
    ];
    suggestion.reasons.insert("ticks", reasons);
    let layout = report.layout.as_ref().map_or("unknown", |layout| layout.name());
    suggestion.reasons.insert(
        "episodes",
        vec![format!(
            "the file lists its episodes itself (layout {layout:?}): {} with {} rows",
            report.episodes, report.steps
        )],
    );
    suggestion
}

/// Suggests a contract for a LeRobot folder.
pub(crate) fn of_lerobot(recording: &LerobotRecording) -> Suggestion {
    let info = &recording.dataset().info;
    let columns: Vec<NamedColumn> = recording
        .channels()
        .iter()
        .map(|channel| {
            let declared = info.feature(&channel.topic);
            let is_image = channel.schema.as_deref().is_some_and(|s| s.name.ends_with("CompressedImage"));
            let is_number = declared.is_some_and(|feature| feature.is_numeric());
            let width = declared.map_or(0, |feature| feature.width());
            let names = declared.map(|feature| feature.names.clone()).unwrap_or_default();
            NamedColumn {
                name: channel.topic.clone(),
                is_image,
                is_list: channel.schema.as_deref().is_some_and(|s| s.data.windows(2).any(|two| two == b"[]")),
                width: if is_number && !is_image { width } else { 0 },
                names: if names.len() == width { names } else { Vec::new() },
            }
        })
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
    for absent in recording.unavailable() {
        suggestion.unmapped.push(format!("{}: {}", absent.topic, absent.detail));
    }
    suggestion
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
        None => grouped,
    };
    let period_ms = 1000.0 / f64::from(fps);
    // Rows lie one period apart; a little more, so that rounding is no gap.
    let tolerance_ms = (period_ms * 1.5 * 1000.0).round() / 1000.0;
    for state in &states {
        let mut stream = stream_of(state, "observation.state", tolerance_ms);
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
    for image in columns.iter().filter(|column| column.is_image) {
        let last = image.name.rsplit(['/', '.']).next().unwrap_or(&image.name);
        let feature = format!("observation.images.{last}");
        push(&mut suggestion, stream_of(image, &feature, tolerance_ms), image, "images");
    }
    let used: Vec<Option<String>> =
        suggestion.contract.stream.iter().map(|stream| stream.topic.clone()).collect();
    for column in columns.iter().filter(|column| !used.contains(&Some(column.name.clone()))) {
        let what = match column.width {
            0 => "text, or too wide".to_owned(),
            1 => "1 value".to_owned(),
            n => format!("{n} values"),
        };
        suggestion.unmapped.push(format!("{}: {what}", column.name));
    }
    suggestion
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
