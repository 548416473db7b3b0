//! What a contract means: checked, with defaults, in nanoseconds and SI.

use std::collections::BTreeSet;

use gawm_schema::{EulerSequence, Kind, Role, Unit, UnitConversion, Wrap};

use super::{
    ActionSpec, ActionTimingSpec, AlignSpec, Causal, Contract, ContractError, EpisodeSource, GapRule,
    ImageSpec, KindSpec, MarkerValue, NonFiniteRule, ReduceSpec, RoleSpec, StreamSpec, TickMode,
    TopicPattern,
};
use crate::align::{ActionTiming, Derivation, Reduction};

/// A contract whose rules hold, as far as no log is needed to tell.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckedContract {
    /// What was written.
    pub written: Contract,
    /// Name of the file, for errors.
    pub file: String,
    /// The streams, in order.
    pub streams: Vec<CheckedStream>,
    /// When rows are made.
    pub ticks: TickRule,
    /// Where episodes begin and end.
    pub episodes: EpisodeRule,
    /// Disorder window.
    pub disorder_window_ns: i64,
    /// Longest silence within an episode.
    pub max_gap_ns: i64,
    /// Whether log times decide what is known at a tick.
    pub by_arrival: bool,
    /// What is odd, but can be used.
    pub warnings: Vec<String>,
}

/// When rows are made.
#[derive(Debug, Clone, PartialEq)]
pub enum TickRule {
    /// A fixed rate.
    Fixed {
        /// Ticks per second.
        rate_hz: f64,
    },
    /// The samples of a stream, by its name in the contract.
    Reference {
        /// Name of the stream.
        stream: String,
    },
}

/// Where episodes begin and end.
#[derive(Debug, Clone, PartialEq)]
pub enum EpisodeRule {
    /// A recording is an episode.
    File,
    /// A topic says so.
    Marker {
        /// The topic.
        topic: String,
        /// Path of the value.
        field: String,
        /// Values that start one.
        start: MarkerValue,
        /// Values that end one; none when each start ends the one before.
        stop: Option<MarkerValue>,
        /// Clock of the markers.
        clock: Clock,
    },
    /// Metadata records give the times.
    Metadata {
        /// Name of the records.
        record: String,
        /// Key of the start.
        start_key: String,
        /// Key of the end.
        end_key: String,
        /// Nanoseconds per unit of those times.
        scale_ns: f64,
    },
    /// Silence separates them.
    Gap {
        /// Shortest silence.
        gap_ns: i64,
    },
}

/// Where the time of a sample is read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Clock {
    /// The header stamp; where a message type has none, the publish time.
    Stamp,
    /// The publish time of the log.
    Publish,
    /// The log time.
    Log,
    /// A field of the message.
    Field(String),
}

/// One stream of the contract, before topics are known.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckedStream {
    /// Name, unique unless the topic is a pattern.
    pub name: Option<String>,
    /// Place in the contract, for errors.
    pub index: usize,
    /// Topic; none for derived actions.
    pub topic: Option<TopicPattern>,
    /// Column, possibly with `{1}`.
    pub feature: String,
    /// What the column is for.
    pub role: Role,
    /// Clock of its samples.
    pub clock: Clock,
    /// Alignment.
    pub align: AlignSpec,
    /// Tolerance.
    pub tolerance_ns: Option<i64>,
    /// Added to each time.
    pub offset_ns: i64,
    /// What happens in a gap.
    pub gap: GapRule,
    /// What happens to NaN.
    pub non_finite: NonFiniteRule,
    /// Numbers or images.
    pub data: StreamData,
}

/// What a stream carries.
#[derive(Debug, Clone, PartialEq)]
pub enum StreamData {
    /// Numbers.
    Vector(VectorRule),
    /// Images.
    Image(ImageRule),
    /// An action made from the state.
    Derived {
        /// The feature it is made from.
        from: String,
        /// How.
        derivation: Derivation,
    },
}

/// What is done to numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct VectorRule {
    /// Paths, in order.
    pub fields: Vec<String>,
    /// Kind of all values.
    pub kind: Kind,
    /// Conversion to SI.
    pub unit: UnitConversion,
    /// Frame.
    pub frame: Option<String>,
    /// Limits in the recorded unit, one or one per value.
    pub limits: Vec<[f64; 2]>,
    /// Names, empty for the default.
    pub names: Vec<String>,
    /// How commands become actions, for actions.
    pub timing: Option<ActionTiming>,
}

/// What is done to images.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageRule {
    /// As written.
    pub spec: ImageSpec,
}

/// Checks a contract; `file` is only named in errors.
///
/// # Errors
/// The first rule that does not hold, with its key, what was expected and what was there.
pub fn check(contract: &Contract, file: &str) -> Result<CheckedContract, ContractError> {
    let checker = Checker { file };
    checker.in_range("disorder_window_ms", contract.disorder_window_ms, 0.0, 3.6e6)?;
    checker.in_range("max_gap_s", contract.max_gap_s, 0.001, 3.6e6)?;
    checker.in_range("split.validation", contract.split.validation, 0.0, 1.0)?;
    checker.in_range("episodes.min_length_s", contract.episodes.min_length_s, 0.0, 3.6e6)?;
    if contract.version != 1 {
        return Err(checker.value("version", "1", &contract.version.to_string(), ""));
    }
    if contract.task_schema.is_some() {
        return Err(checker.value("task_schema", "a contract that is read from a file", "a text", ""));
    }
    if contract.stream.is_empty() {
        let hint = "add [[stream]] tables, or let `gawm-ingest suggest LOG` write them";
        return Err(checker.value("stream", "at least one stream", "none", hint));
    }
    let mut warnings = Vec::new();
    let mut streams = Vec::new();
    for (index, spec) in contract.stream.iter().enumerate() {
        streams.push(checker.stream(index, spec, &mut warnings)?);
    }
    number_default_names(&mut streams, contract);
    checker.names(&streams)?;
    checker.derived(&streams)?;
    Ok(CheckedContract {
        file: file.to_owned(),
        ticks: checker.ticks(contract, &streams)?,
        episodes: checker.episodes(contract)?,
        streams,
        disorder_window_ns: nanos(contract.disorder_window_ms),
        max_gap_ns: nanos(contract.max_gap_s * 1e3),
        by_arrival: contract.causal == Causal::Arrival,
        written: contract.clone(),
        warnings,
    })
}

struct Checker<'a> {
    file: &'a str,
}

impl Checker<'_> {
    fn value(&self, key: &str, expected: &str, got: &str, hint: &str) -> ContractError {
        ContractError::Value {
            file: self.file.to_owned(),
            key: key.to_owned(),
            expected: expected.to_owned(),
            got: got.to_owned(),
            hint: hint.to_owned(),
        }
    }

    fn in_range(&self, key: &str, value: f64, low: f64, high: f64) -> Result<(), ContractError> {
        if value >= low && value <= high {
            return Ok(());
        }
        Err(self.value(key, &format!("a number from {low} to {high}"), &value.to_string(), ""))
    }

    fn names(&self, streams: &[CheckedStream]) -> Result<(), ContractError> {
        let mut seen = BTreeSet::new();
        for stream in streams {
            if let Some(name) = &stream.name
                && !seen.insert(name)
            {
                return Err(self.value(&key_of(stream), "a unique name", &format!("{name:?} again"), ""));
            }
        }
        Ok(())
    }

    fn derived(&self, streams: &[CheckedStream]) -> Result<(), ContractError> {
        for stream in streams {
            if let StreamData::Derived { from, .. } = &stream.data {
                let known: Vec<&str> = streams
                    .iter()
                    .filter(|other| matches!(other.data, StreamData::Vector(_)) && other.role != Role::Action)
                    .map(|other| other.feature.as_str())
                    .collect();
                if !known.contains(&from.as_str()) {
                    let expected = format!("one of the vector features {known:?}");
                    return Err(self.value(&format!("{}.action.from", key_of(stream)), &expected, from, ""));
                }
            }
        }
        Ok(())
    }

    fn ticks(&self, contract: &Contract, streams: &[CheckedStream]) -> Result<TickRule, ContractError> {
        let ticks = &contract.ticks;
        if let Some(fps) = ticks.fps
            && !(1..=100_000).contains(&fps)
        {
            return Err(self.value("ticks.fps", "an integer from 1 to 100000", &fps.to_string(), ""));
        }
        match ticks.mode {
            TickMode::Fixed => {
                let Some(rate_hz) = ticks.rate_hz.or(ticks.fps.map(f64::from)) else {
                    let hint = "rows need a rate; 10 to 30 Hz are usual for manipulation";
                    return Err(self.value("ticks.rate_hz", "ticks per second", "nothing", hint));
                };
                self.in_range("ticks.rate_hz", rate_hz, 0.01, 100_000.0)?;
                self.fps_of(contract, rate_hz)?;
                Ok(TickRule::Fixed { rate_hz })
            }
            TickMode::Reference | TickMode::Native if ticks.rate_hz.is_some() => Err(self.value(
                "ticks.rate_hz",
                "nothing: the rate is that of the stream",
                "a number",
                "use ticks.fps to state the nominal rate",
            )),
            TickMode::Reference => {
                let names: Vec<&str> = streams.iter().filter_map(|stream| stream.name.as_deref()).collect();
                match &ticks.stream {
                    Some(name) if names.contains(&name.as_str()) => {
                        Ok(TickRule::Reference { stream: name.clone() })
                    }
                    other => {
                        let expected = format!("the name of a stream, one of {names:?}");
                        let got = other.as_deref().unwrap_or("nothing");
                        Err(self.value("ticks.stream", &expected, got, "give the stream a `name`"))
                    }
                }
            }
            TickMode::Native => {
                let is_state = |stream: &&CheckedStream| stream.role == Role::State && stream.topic.is_some();
                let first =
                    streams.iter().find(is_state).or_else(|| streams.iter().find(|s| s.topic.is_some()));
                match first.and_then(|stream| stream.name.clone()) {
                    Some(stream) => Ok(TickRule::Reference { stream }),
                    None => Err(self.value("ticks.mode", "a stream with one topic", "none", "")),
                }
            }
        }
    }

    fn fps_of(&self, contract: &Contract, rate_hz: f64) -> Result<(), ContractError> {
        let nearest = rate_hz.round().max(1.0);
        if contract.ticks.fps.is_none() && (nearest - rate_hz).abs() > 0.01 * rate_hz {
            let expected = format!("an integer to write to info.json beside a rate of {rate_hz} Hz");
            let hint = format!("fps = {nearest} would be {:.1} % off", 100.0 * (nearest / rate_hz - 1.0));
            return Err(self.value("ticks.fps", &expected, "nothing", &hint));
        }
        Ok(())
    }

    fn episodes(&self, contract: &Contract) -> Result<EpisodeRule, ContractError> {
        let spec = &contract.episodes;
        let need = |key: &str, value: &Option<String>| match value {
            Some(text) => Ok(text.clone()),
            None => {
                let mode = format!("{:?}", spec.from).to_lowercase();
                Err(self.value(
                    &format!("episodes.{key}"),
                    &format!("a value, for from = {mode:?}"),
                    "nothing",
                    "",
                ))
            }
        };
        Ok(match spec.from {
            EpisodeSource::File => EpisodeRule::File,
            EpisodeSource::Marker => EpisodeRule::Marker {
                topic: need("topic", &spec.topic)?,
                field: need("field", &spec.field)?,
                start: spec.start.clone().unwrap_or(MarkerValue::Bool(true)),
                stop: spec.stop.clone().or_else(|| spec.start.is_none().then_some(MarkerValue::Bool(false))),
                clock: clock(&spec.clock),
            },
            EpisodeSource::Metadata => EpisodeRule::Metadata {
                record: need("record", &spec.record)?,
                start_key: need("start_key", &spec.start_key)?,
                end_key: need("end_key", &spec.end_key)?,
                scale_ns: match spec.time_unit {
                    super::TimeUnit::Ns => 1.0,
                    super::TimeUnit::S => 1e9,
                },
            },
            EpisodeSource::Gap => {
                let gap_s = spec.gap_s.unwrap_or(contract.max_gap_s);
                self.in_range("episodes.gap_s", gap_s, 0.001, 3.6e6)?;
                EpisodeRule::Gap { gap_ns: nanos(gap_s * 1e3) }
            }
        })
    }

    fn stream(
        &self,
        index: usize,
        spec: &StreamSpec,
        warnings: &mut Vec<String>,
    ) -> Result<CheckedStream, ContractError> {
        let role = role_of(spec);
        let pattern = spec.topic.as_deref().map(TopicPattern::new);
        let is_glob = pattern.as_ref().is_some_and(TopicPattern::is_glob);
        let name = spec.name.clone().or_else(|| {
            let base = spec.topic.as_deref().map(|topic| topic.trim_matches('/').replace('/', "_"));
            if is_glob { None } else { base }
        });
        let mut stream = CheckedStream {
            name,
            index,
            topic: pattern,
            feature: spec.feature.clone(),
            role,
            clock: clock(&spec.clock),
            align: spec.align.unwrap_or(AlignSpec::Asof),
            tolerance_ns: None,
            offset_ns: nanos(spec.offset_ms),
            gap: spec.gap,
            non_finite: spec.non_finite,
            data: StreamData::Image(ImageRule { spec: ImageSpec::default() }),
        };
        let key = key_of(&stream);
        self.in_range(&format!("{key}.offset_ms"), spec.offset_ms, -3.6e6, 3.6e6)?;
        if spec.feature.is_empty() || spec.feature.contains('/') {
            let expected = "a column name without '/'";
            return Err(self.value(&format!("{key}.feature"), expected, &format!("{:?}", spec.feature), ""));
        }
        stream.tolerance_ns = self.tolerance(&key, spec, stream.align)?;
        stream.data = match (role, &spec.topic) {
            (_, None) => self.derived_rule(&key, spec, role)?,
            (Role::Image, Some(_)) => self.image_rule(&key, spec, stream.align)?,
            _ => self.vector_rule(&key, spec, &stream, warnings)?,
        };
        Ok(stream)
    }

    fn tolerance(
        &self,
        key: &str,
        spec: &StreamSpec,
        align: AlignSpec,
    ) -> Result<Option<i64>, ContractError> {
        let key = format!("{key}.tolerance_ms");
        match spec.tolerance_ms {
            Some(ms) => {
                self.in_range(&key, ms, 0.0, 3.6e6)?;
                Ok(Some(nanos(ms)))
            }
            None if align == AlignSpec::Hold || spec.topic.is_none() => Ok(None),
            None => {
                let hint = "2 to 3 periods of the stream are usual; `align = \"hold\"` needs none";
                Err(self.value(&key, "the oldest usable sample in ms", "nothing", hint))
            }
        }
    }

    fn image_rule(
        &self,
        key: &str,
        spec: &StreamSpec,
        align: AlignSpec,
    ) -> Result<StreamData, ContractError> {
        if !spec.fields.is_empty() {
            let got = format!("{} fields", spec.fields.len());
            return Err(self.value(&format!("{key}.fields"), "nothing for an image", &got, ""));
        }
        if matches!(align, AlignSpec::Linear | AlignSpec::Slerp) {
            let expected = "asof, hold or nearest: images are not interpolated";
            return Err(self.value(
                &format!("{key}.align"),
                expected,
                &format!("{align:?}").to_lowercase(),
                "",
            ));
        }
        let image = spec.image.clone().unwrap_or_default();
        for (name, sizes) in
            [("crop", image.crop.map(|[_, _, width, height]| [width, height])), ("resize", image.resize)]
        {
            if let Some(sizes) = sizes
                && sizes.iter().any(|size| !(1..=16_384).contains(size))
            {
                let got = format!("{sizes:?}");
                return Err(self.value(
                    &format!("{key}.image.{name}"),
                    "a width and height from 1 to 16384",
                    &got,
                    "",
                ));
            }
        }
        if let Some(quality) = image.quality
            && !(1..=100).contains(&quality)
        {
            return Err(self.value(&format!("{key}.image.quality"), "1 to 100", &quality.to_string(), ""));
        }
        Ok(StreamData::Image(ImageRule { spec: image }))
    }

    fn derived_rule(&self, key: &str, spec: &StreamSpec, role: Role) -> Result<StreamData, ContractError> {
        let rule = spec.action.as_ref().filter(|rule| rule.timing == ActionTimingSpec::Derived);
        match rule {
            Some(ActionSpec { from: Some(from), derived, .. }) if role == Role::Action => {
                Ok(StreamData::Derived {
                    from: from.clone(),
                    derivation: match derived {
                        Some(super::DerivedSpec::Difference) => Derivation::Difference,
                        _ => Derivation::Next,
                    },
                })
            }
            _ => {
                let hint = "only a derived action has none: action = { timing = \"derived\", from = \"observation.state\" }";
                Err(self.value(&format!("{key}.topic"), "a topic", "nothing", hint))
            }
        }
    }

    fn vector_rule(
        &self,
        key: &str,
        spec: &StreamSpec,
        stream: &CheckedStream,
        warnings: &mut Vec<String>,
    ) -> Result<StreamData, ContractError> {
        if spec.fields.is_empty() {
            let hint = "`gawm-ingest inspect LOG` lists what a topic has";
            return Err(self.value(&format!("{key}.fields"), "at least one path", "none", hint));
        }
        let kind = self.kind(key, spec)?;
        let unit = unit_of(spec, kind);
        if !unit.is_known {
            warnings.push(format!(
                "{key}.unit: {:?} is not a known unit; values are kept as they are",
                unit.si.0
            ));
        }
        let is_rotation = kind.raw_width() > 1;
        let bad = match stream.align {
            AlignSpec::Linear if is_rotation => Some("slerp for rotations"),
            AlignSpec::Slerp if !is_rotation => {
                Some("linear; slerp is for quaternion, rotvec, euler and matrix")
            }
            AlignSpec::Linear if matches!(kind, Kind::Bool) => Some("hold, asof or nearest for truth values"),
            _ => None,
        };
        if let Some(expected) = bad {
            let got = format!("{:?}", stream.align).to_lowercase();
            return Err(self.value(&format!("{key}.align"), expected, &got, ""));
        }
        for limits in &spec.limits {
            if limits[0].is_nan() || limits[1].is_nan() || limits[0] > limits[1] {
                let got = format!("{limits:?}");
                return Err(self.value(&format!("{key}.limits"), "[low, high] with low <= high", &got, ""));
            }
        }
        let timing = match (stream.role, &spec.action) {
            (Role::Action, action) => Some(self.timing(key, action.as_ref(), kind)?),
            (_, Some(_)) => {
                return Err(self.value(
                    &format!("{key}.action"),
                    "nothing: the role is not action",
                    "a rule",
                    "",
                ));
            }
            (_, None) => None,
        };
        Ok(StreamData::Vector(VectorRule {
            fields: spec.fields.clone(),
            kind,
            unit,
            frame: spec.frame.clone(),
            limits: spec.limits.clone(),
            names: spec.names.clone(),
            timing,
        }))
    }

    fn timing(
        &self,
        key: &str,
        spec: Option<&ActionSpec>,
        kind: Kind,
    ) -> Result<ActionTiming, ContractError> {
        let Some(spec) = spec else {
            let expected = "how commands become actions: in-force, next, window or derived";
            let hint = "`gawm-ingest suggest LOG` proposes one from the measured delay of the robot";
            return Err(self.value(&format!("{key}.action"), expected, "nothing", hint));
        };
        let refused =
            |expected: &str, got: &str| Err(self.value(&format!("{key}.action.reduce"), expected, got, ""));
        match (spec.timing, spec.reduce, spec.n) {
            (ActionTimingSpec::InForce, None, None) => Ok(ActionTiming::InForce),
            (ActionTimingSpec::Next, None, None) => Ok(ActionTiming::Next),
            (ActionTimingSpec::Window, None, Some(n)) if (1..=1000).contains(&n) => {
                Ok(ActionTiming::Resample(n))
            }
            (ActionTimingSpec::Window, Some(reduce), None) => Ok(ActionTiming::Reduce(match reduce {
                ReduceSpec::Last => Reduction::Last,
                _ if kind == Kind::Bool => return refused("last for truth values", "another"),
                ReduceSpec::Mean if kind.raw_width() > 1 => {
                    return refused("last or compose for rotations", "mean");
                }
                ReduceSpec::Mean => Reduction::Mean,
                ReduceSpec::Sum if kind.raw_width() > 1 => return refused("compose for rotations", "sum"),
                ReduceSpec::Sum => Reduction::Sum,
                ReduceSpec::Compose => {
                    Reduction::Compose { in_body_frame: spec.delta_frame == super::DeltaFrame::Body }
                }
            })),
            (ActionTimingSpec::Window, ..) => {
                let expected = "either n (1 to 1000, resampled) or reduce (last, mean, sum, compose)";
                Err(self.value(&format!("{key}.action"), expected, "neither or both", ""))
            }
            (ActionTimingSpec::Derived, ..) => {
                let expected = "no topic and no fields for a derived action";
                Err(self.value(&format!("{key}.action"), expected, "a topic", ""))
            }
            _ => {
                Err(self.value(&format!("{key}.action"), "n and reduce only with window", "one of them", ""))
            }
        }
    }

    fn kind(&self, key: &str, spec: &StreamSpec) -> Result<Kind, ContractError> {
        let only = |name: &str, is_set: bool, kinds: &str| {
            if is_set {
                let expected = format!("nothing: it is for kind = {kinds:?}");
                return Err(self.value(&format!("{key}.{name}"), &expected, "a value", ""));
            }
            Ok(())
        };
        if spec.kind != KindSpec::Quaternion {
            only("order", spec.order.is_some(), "quaternion")?;
        }
        if spec.kind != KindSpec::Angle {
            only("wrap", spec.wrap.is_some(), "angle")?;
        }
        if spec.kind != KindSpec::Euler {
            only("sequence", spec.sequence.is_some(), "euler")?;
        }
        Ok(match spec.kind {
            KindSpec::Linear => Kind::Linear,
            KindSpec::Angle => Kind::Angle { wrap: spec.wrap.unwrap_or(Wrap::None) },
            KindSpec::Quaternion => match spec.order {
                Some(order) => Kind::Quaternion { order },
                None => {
                    let hint = "ROS and SciPy use xyzw, MuJoCo wxyz";
                    return Err(self.value(&format!("{key}.order"), "xyzw or wxyz", "nothing", hint));
                }
            },
            KindSpec::Rotvec => Kind::Rotvec,
            KindSpec::Euler => match spec.sequence {
                Some(sequence) => Kind::Euler { sequence },
                None => {
                    let names = [EulerSequence::ExtrinsicXyz, EulerSequence::IntrinsicZyx];
                    let expected = "xyz or zyx (fixed axes), XYZ or ZYX (moving axes)";
                    let hint = format!("roll, pitch, yaw of ROS are {:?}", names[0]);
                    return Err(self.value(&format!("{key}.sequence"), expected, "nothing", &hint));
                }
            },
            KindSpec::Matrix => Kind::Matrix,
            KindSpec::Gripper => Kind::Gripper,
            KindSpec::Bool => Kind::Bool,
            KindSpec::Direction => Kind::Direction,
        })
    }
}

/// Numbers the names that were not given where several streams read one topic.
fn number_default_names(streams: &mut [CheckedStream], contract: &Contract) {
    let mut used: BTreeSet<String> = contract.stream.iter().filter_map(|spec| spec.name.clone()).collect();
    for (stream, spec) in streams.iter_mut().zip(&contract.stream) {
        if let (None, Some(base)) = (&spec.name, stream.name.take()) {
            let mut name = base.clone();
            let mut number = 2;
            while !used.insert(name.clone()) {
                name = format!("{base}_{number}");
                number += 1;
            }
            stream.name = Some(name);
        } else {
            stream.name = spec.name.clone();
        }
    }
}

fn role_of(spec: &StreamSpec) -> Role {
    match spec.role {
        Some(RoleSpec::State) => Role::State,
        Some(RoleSpec::Action) => Role::Action,
        Some(RoleSpec::Image) => Role::Image,
        Some(RoleSpec::Observation) => Role::Observation,
        Some(RoleSpec::Annotation) => Role::Annotation,
        None if spec.feature == "action" || spec.feature.starts_with("action.") => Role::Action,
        None if spec.feature.starts_with("observation.images.") => Role::Image,
        None if spec.feature.starts_with("observation.state") => Role::State,
        None if spec.feature.starts_with("annotation.") => Role::Annotation,
        None => Role::Observation,
    }
}

fn unit_of(spec: &StreamSpec, kind: Kind) -> UnitConversion {
    let default = match kind {
        Kind::Angle { .. } | Kind::Rotvec | Kind::Euler { .. } => "rad",
        _ => "1",
    };
    Unit::conversion(spec.unit.as_deref().unwrap_or(default))
}

fn clock(text: &str) -> Clock {
    match text {
        "stamp" => Clock::Stamp,
        "publish" => Clock::Publish,
        "log" => Clock::Log,
        path => Clock::Field(path.to_owned()),
    }
}

fn key_of(stream: &CheckedStream) -> String {
    let shown = stream.name.as_deref().or(stream.topic.as_ref().map(TopicPattern::as_str));
    match shown {
        Some(shown) => format!("stream[{}] ({shown})", stream.index),
        None => format!("stream[{}]", stream.index),
    }
}

fn nanos(ms: f64) -> i64 {
    (ms * 1e6).round() as i64
}
