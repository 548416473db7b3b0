//! The contract as it is written: plain serde structs, every default in one place.

use std::collections::BTreeMap;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How logs become a dataset: the `[ingest]` section of a pipeline, or a file of its own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Contract {
    /// Version of this format; only 1 exists.
    pub version: u32,
    /// Kind of robot, copied to the dataset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot_type: Option<String>,
    /// Folders of `.msg` files for channels without a schema, relative to the contract.
    pub schemas: Vec<PathBuf>,
    /// Which time decides what is known at a tick.
    pub causal: Causal,
    /// Messages may come this much out of order, in ms; later ones are lost as `beyond_disorder_window`.
    pub disorder_window_ms: f64,
    /// When no mapped stream has a sample for longer than this, in s, the episode is split whatever the gap rules say.
    pub max_gap_s: f64,
    /// How numbers are stored: `float64` (lossless for what logs hold) or `float32`.
    pub float: gawm_schema::FloatType,
    /// How episodes lie in HDF5 and npz files; found from their columns by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub layout: Option<crate::tabular::Layout>,
    /// A task schema, whose streams come before those below.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_schema: Option<super::TaskSchemaSpec>,
    /// When rows are made.
    pub ticks: TicksSpec,
    /// What becomes of which topic, in the order of the columns.
    pub stream: Vec<StreamSpec>,
    /// Where episodes begin and end.
    pub episodes: EpisodesSpec,
    /// Task, success, operator, robot and session of each episode.
    pub labels: LabelsSpec,
    /// What is kept of calibrations.
    pub calibration: CalibrationSpec,
    /// How much is held back for validation.
    pub split: SplitSpec,
}

impl Default for Contract {
    fn default() -> Self {
        Self {
            version: 1,
            robot_type: None,
            schemas: Vec::new(),
            causal: Causal::Stamp,
            disorder_window_ms: 1000.0,
            max_gap_s: 5.0,
            layout: None,
            task_schema: None,
            ticks: TicksSpec::default(),
            stream: Vec::new(),
            episodes: EpisodesSpec::default(),
            labels: LabelsSpec::default(),
            calibration: CalibrationSpec::default(),
            split: SplitSpec::default(),
            float: gawm_schema::FloatType::Float64,
        }
    }
}

/// Which time decides what is known at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Causal {
    /// The clock that each stream states.
    #[default]
    Stamp,
    /// The log time: what a deployed robot would have had.
    Arrival,
}

/// When rows are made.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TicksSpec {
    /// How ticks are laid.
    pub mode: TickMode,
    /// Ticks per second, for `fixed`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// The integer written to info.json; needed only where the nearest integer is over 1 % off.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fps: Option<u32>,
    /// Name of the stream whose samples are the ticks, for `reference`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stream: Option<String>,
}

/// How ticks are laid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TickMode {
    /// A fixed rate from the first instant of each episode at which all required streams are there.
    #[default]
    Fixed,
    /// One tick per sample of a stream.
    Reference,
    /// One tick per sample of the first state stream (of the first stream, when there is no state).
    Native,
}

/// What becomes of one topic, or of several that a pattern matches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StreamSpec {
    /// Unique name, used for ages and messages; from the topic by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Topic, exact or with `*` (within one level), `**` (across levels) and `?`; absent for a derived action.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// Paths of the values within a message, in order; none for images.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub fields: Vec<String>,
    /// Column of the dataset; streams of one feature are joined in the order they are written. `{1}` is what the first wildcard matched.
    pub feature: String,
    /// What the column is for; from its name by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub role: Option<RoleSpec>,
    /// `stamp`, `publish`, `log`, or the path of a time field.
    #[serde(default = "default_clock")]
    pub clock: String,
    /// How a value at a tick is made of samples; `asof` by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub align: Option<AlignSpec>,
    /// Oldest usable sample (widest bridged gap for `linear` and `slerp`), in ms. Needed except for `hold`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tolerance_ms: Option<f64>,
    /// Added to every time of the stream, in ms: minus the known latency of a sensor, plus the delay of an actuator.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub offset_ms: f64,
    /// What happens where no sample is usable.
    #[serde(default)]
    pub gap: GapRule,
    /// What happens to samples with NaN or infinite values.
    #[serde(default)]
    pub non_finite: NonFiniteRule,
    /// Unit of the recorded values; converted to SI.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// What the values are geometrically.
    #[serde(default)]
    pub kind: KindSpec,
    /// Component order of a quaternion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub order: Option<gawm_schema::QuaternionOrder>,
    /// Interval that recorded angles are wrapped to, after conversion to rad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wrap: Option<gawm_schema::Wrap>,
    /// Axes of Euler angles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sequence: Option<gawm_schema::EulerSequence>,
    /// Coordinate frame of the values.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<String>,
    /// Physical limits, one [low, high] for all values or one each, in the recorded unit.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub limits: Vec<[f64; 2]>,
    /// Names of the values; from the paths by default.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub names: Vec<String>,
    /// How an action stream's commands become the action of a row.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub action: Option<ActionSpec>,
    /// What is done to images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<ImageSpec>,
}

fn default_clock() -> String {
    "stamp".to_owned()
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature serde asks for")]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// What a column is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RoleSpec {
    /// Measured physical state.
    State,
    /// Commands.
    Action,
    /// A camera.
    Image,
    /// Any other observation.
    Observation,
    /// A per-frame annotation such as an intervention flag.
    Annotation,
}

/// How a value at tick t is made of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum AlignSpec {
    /// The last sample at or before t, no older than the tolerance.
    Asof,
    /// The last sample at or before t, however old unless a tolerance is given.
    Hold,
    /// The sample nearest to t, within the tolerance; may be a later one.
    Nearest,
    /// Between the samples before and after t; angles go the short way.
    Linear,
    /// Rotations between the samples before and after t.
    Slerp,
}

/// What happens where no sample is usable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum GapRule {
    /// The episode ends before the gap and another begins after it.
    #[default]
    Split,
    /// Rows are kept, numbers are NaN, images are held, validity is false.
    Mask,
    /// The whole episode is left out.
    DropEpisode,
    /// The run fails.
    Fail,
}

/// What happens to samples with NaN or infinite values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum NonFiniteRule {
    /// The row is kept; the feature is NaN and not valid in it.
    #[default]
    Mask,
    /// They are a gap: the gap rule applies.
    Gap,
    /// The message is lost, as if it had not been recorded.
    Reject,
}

/// What values are geometrically.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum KindSpec {
    /// A Euclidean quantity.
    #[default]
    Linear,
    /// Angles; `wrap` says to which interval they are wrapped (none by default).
    Angle,
    /// A unit quaternion; `order` is needed.
    Quaternion,
    /// Axis times angle.
    Rotvec,
    /// Three angles; `sequence` is needed.
    Euler,
    /// A 3x3 rotation matrix, row-major.
    Matrix,
    /// A gripper opening or command.
    Gripper,
    /// Truth values.
    Bool,
    /// Components of a unit vector as recorded, such as cosine and sine of a yaw: never standardised.
    Direction,
}

/// How commands become the action of row t, which acts between tick t and the next.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ActionSpec {
    /// Which commands count.
    pub timing: ActionTimingSpec,
    /// Number of commands per row, for `window` without `reduce`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub n: Option<usize>,
    /// How the commands of a window become one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reduce: Option<ReduceSpec>,
    /// Frame in which successive rotation deltas are expressed, for `compose`.
    #[serde(default)]
    pub delta_frame: DeltaFrame,
    /// Feature that a derived action is made from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// What a derived action is.
    #[serde(default, rename = "as", skip_serializing_if = "Option::is_none")]
    pub derived: Option<DerivedSpec>,
}

/// Which commands count for a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ActionTimingSpec {
    /// The last command at or before t.
    InForce,
    /// The first command after t, at the next tick at the latest.
    Next,
    /// All commands after t up to the next tick.
    Window,
    /// Made from the state: the log has no commands.
    Derived,
}

/// How the commands of a window become one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ReduceSpec {
    /// The last one.
    Last,
    /// Their mean (of angles on the circle).
    Mean,
    /// Their sum, for linear deltas.
    Sum,
    /// Their composition: linear parts are added, rotations multiplied.
    Compose,
}

/// The frame of rotation deltas.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum DeltaFrame {
    /// Deltas are about the axes of a fixed base: the later one is applied on the left.
    #[default]
    Base,
    /// Deltas are about the axes of the moving body: the later one is applied on the right.
    Body,
}

/// What a derived action is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum DerivedSpec {
    /// The state of the next row.
    Next,
    /// The state of the next row minus that of this one; a rotation vector for rotations.
    Difference,
}

/// What is done to images.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ImageSpec {
    /// Part that is kept: x, y, width, height in pixels of the recorded image.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crop: Option<[u32; 4]>,
    /// Width and height in the dataset, after the crop.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub resize: Option<[u32; 2]>,
    /// How images are stored.
    pub format: ImageFormat,
    /// JPEG quality, 1 to 100.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quality: Option<u8>,
    /// Whether pixels are distances; found from the encoding by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<bool>,
    /// Topic of the camera's calibration (CameraInfo); crop and resize update its K and P.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera_info: Option<String>,
}

/// How images are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ImageFormat {
    /// JPEG and PNG as recorded; raw images, and all that are cropped or resized, as PNG.
    #[default]
    Passthrough,
    /// PNG, lossless.
    Png,
    /// JPEG.
    Jpeg,
}

/// Where episodes begin and end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EpisodesSpec {
    /// What separates episodes.
    pub from: EpisodeSource,
    /// Topic of the markers, for `marker`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// Path of the marker's value; may go on into a text that holds JSON.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// Value that starts an episode; `true` by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<MarkerValue>,
    /// Value that ends an episode; `false` by default. Without one, each start ends the episode before.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stop: Option<MarkerValue>,
    /// Clock of the markers: `log`, `publish`, `stamp` or a path.
    pub clock: String,
    /// Name of the MCAP metadata records, one per episode, for `metadata`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub record: Option<String>,
    /// Key of the start time in such a record.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_key: Option<String>,
    /// Key of the end time in such a record.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub end_key: Option<String>,
    /// Unit of those times.
    pub time_unit: TimeUnit,
    /// Silence of all mapped streams that separates episodes, in s, for `gap`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gap_s: Option<f64>,
    /// Episodes shorter than this, in s, are left out and counted.
    pub min_length_s: f64,
    /// Episodes of fewer rows are left out and counted.
    pub min_frames: u32,
}

impl Default for EpisodesSpec {
    fn default() -> Self {
        Self {
            from: EpisodeSource::File,
            topic: None,
            field: None,
            start: None,
            stop: None,
            clock: "log".to_owned(),
            record: None,
            start_key: None,
            end_key: None,
            time_unit: TimeUnit::Ns,
            gap_s: None,
            min_length_s: 0.0,
            min_frames: 2,
        }
    }
}

/// What separates episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum EpisodeSource {
    /// One recording is one episode.
    #[default]
    File,
    /// A topic says when they start and stop.
    Marker,
    /// MCAP metadata records give their times.
    Metadata,
    /// Silence of all mapped streams.
    Gap,
}

/// A value that a marker is compared with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum MarkerValue {
    /// Truth value.
    Bool(bool),
    /// Integer.
    Integer(i64),
    /// Text; `*` and `?` are wildcards.
    Text(String),
    /// Any of several.
    AnyOf(Vec<MarkerValue>),
}

/// Unit of a time in metadata.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TimeUnit {
    /// Nanoseconds.
    #[default]
    Ns,
    /// Seconds.
    S,
}

/// Task, success, operator, robot and session of each episode.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LabelsSpec {
    /// Regular expression on the path of the log as given; named groups `task`, `success`, `operator`, `robot`, `session` fill what has no other source.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path_pattern: Option<String>,
    /// CSV (with a header) or JSON (a list of objects) with one row per log or per episode, relative to the contract.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side_file: Option<PathBuf>,
    /// Column of the side file that names the log: its file name or the end of its path.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side_key: Option<String>,
    /// Column of the side file that numbers the episode within the log, from 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side_episode: Option<String>,
    /// What the robot was asked to do.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task: Option<LabelSource>,
    /// Whether it succeeded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub success: Option<LabelSource>,
    /// Who operated it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub operator: Option<LabelSource>,
    /// Which robot it was.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<LabelSource>,
    /// The session: what must not be torn between training and validation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub session: Option<LabelSource>,
    /// Values of success that mean true; matched without letter case.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub success_values: BTreeMap<String, bool>,
}

/// Where a label comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum LabelSource {
    /// The same for all.
    Constant(String),
    /// The same truth value for all.
    Flag(bool),
    /// A field of a topic: the value in force when the episode starts (success: the last one in it).
    Topic(TopicLabel),
    /// A key of an MCAP metadata record; for episodes from metadata, of the episode's own record first.
    Metadata(MetadataLabel),
    /// A named group of `path_pattern`.
    Capture(CaptureLabel),
    /// A column of the side file.
    Column(ColumnLabel),
}

/// A label from a topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TopicLabel {
    /// Topic, exact.
    pub topic: String,
    /// Path of the value; may go on into a text that holds JSON.
    pub field: String,
}

/// A label from a metadata record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MetadataLabel {
    /// Name of the record.
    pub metadata: String,
    /// Key within it.
    pub key: String,
}

/// A label from the path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CaptureLabel {
    /// Name of the group.
    pub capture: String,
}

/// A label from the side file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ColumnLabel {
    /// Name of the column.
    pub column: String,
}

/// What is kept of calibrations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationSpec {
    /// Whether attachments (URDF, calibration files) are copied to `meta/`.
    pub attachments: bool,
    /// Largest attachment that is copied, in bytes; larger ones are named in a warning.
    pub max_attachment_bytes: u64,
}

impl Default for CalibrationSpec {
    fn default() -> Self {
        Self { attachments: true, max_attachment_bytes: 64 << 20 }
    }
}

/// How much is held back for validation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SplitSpec {
    /// Share of sessions (of episodes where no session is known) that are for validation, 0 to 1.
    pub validation: f64,
}

impl Default for SplitSpec {
    fn default() -> Self {
        Self { validation: 0.1 }
    }
}
