//! Decides what each topic is.

use gawm_schema::QuaternionOrder;
use serde_json::Value;

use super::clock::{clock_of, tolerance_of};
use super::fields::{joints, numbers};
use super::survey::{Survey, Topic};
use super::transforms::transforms;
use super::{Suggestion, names};
use crate::contract::{
    ActionSpec, ActionTimingSpec, AlignSpec, Contract, DeltaFrame, DerivedSpec, GapRule, ImageSpec, KindSpec,
    RoleSpec, StreamSpec, TickMode, TicksSpec,
};
use crate::decode::{CameraInfo, ImagePlan, RowSink, SchemaLibrary, decode_to_json};
use crate::run::{Picture, schema_of};
use gawm_video::PacketDecoder;

/// Ticks per second are not proposed above this: more rows than a model needs.
const MAX_RATE_HZ: f64 = 50.0;
/// Rates that sensors are set to.
const USUAL_RATES_HZ: [f64; 14] =
    [1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 24.0, 25.0, 30.0, 50.0, 60.0, 100.0, 200.0, 1000.0];
/// Rows that a log should give at least.
const MIN_ROWS: f64 = 20.0;

/// What a topic was found to be.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Guess {
    /// Width and height of its images.
    Camera((u32, u32)),
    Vectors(Vec<Group>),
    Skip(String),
}

/// Values of a topic that share a kind.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Group {
    pub(crate) fields: Vec<String>,
    pub(crate) kind: KindSpec,
    pub(crate) unit: Option<String>,
    pub(crate) limits: Vec<[f64; 2]>,
    pub(crate) reason: String,
    /// Whether they are positions of named joints.
    pub(crate) is_joints: bool,
    /// The part of the topic's messages that hold them, where several publishers share it; else 1.
    pub(crate) share: f64,
    /// Names of its values, where paths give poor ones.
    pub(crate) names: Vec<String>,
    /// Whether elements of the message have stamps of their own.
    pub(crate) is_stamped: bool,
}

impl Group {
    /// Returns a group of values that are no joints, from messages of one publisher.
    pub(crate) fn new(fields: Vec<String>, kind: KindSpec, unit: Option<String>, reason: String) -> Group {
        let (limits, names) = (Vec::new(), Vec::new());
        Group { fields, kind, unit, limits, reason, is_joints: false, share: 1.0, names, is_stamped: false }
    }
}

/// Guesses streams, clocks, tolerances and the rate.
pub(crate) fn guess(survey: &Survey, library: &SchemaLibrary) -> Suggestion {
    let mut suggestion = Suggestion { contract: Contract::default(), ..Suggestion::default() };
    let mut found: Vec<(&Topic, Guess)> =
        survey.topics.values().map(|topic| (topic, guess_topic(topic, survey, library))).collect();
    let is_rich = |topic: &Topic| topic.messages >= 2 && topic.recordings == survey.recordings;
    // A log with one message per topic can still be mapped, and `run` then says that it is too short.
    if found.iter().any(|(topic, guess)| is_rich(topic) && !matches!(guess, Guess::Skip(_))) {
        for (topic, guess) in &mut found {
            if !is_rich(topic) && !matches!(guess, Guess::Skip(_)) {
                let text = format!(
                    "{} messages in {} of {} logs",
                    topic.messages, topic.recordings, survey.recordings
                );
                *guess = Guess::Skip(text);
            }
        }
    }
    use_transforms(&mut found, library);
    for (topic, guess) in &found {
        if let Guess::Skip(reason) = guess {
            suggestion.unmapped.push(format!("{} ({}): {reason}", topic.channel.topic, shown_type(topic)));
        }
    }
    add_states(&mut suggestion, survey, &found);
    add_actions(&mut suggestion, &found);
    for (topic, guess) in &found {
        if let Guess::Camera(size) = guess {
            let info = camera_info(topic, *size, survey, library);
            add_camera(&mut suggestion, topic, info);
        }
    }
    add_derived(&mut suggestion);
    set_rate(&mut suggestion, survey, &found);
    set_window(&mut suggestion, survey);
    suggestion
}

fn shown_type(topic: &Topic) -> String {
    let name = topic.type_name();
    if name.is_empty() { format!("{}, no schema", topic.channel.message_encoding) } else { name.to_owned() }
}

/// Where nothing says how the robot stands, the frames that move do.
fn use_transforms(found: &mut [(&Topic, Guess)], library: &SchemaLibrary) {
    let is_pose = |group: &Group| group.is_joints || group.kind == KindSpec::Quaternion;
    let says = |(topic, guess): &(&Topic, Guess)| match guess {
        Guess::Vectors(groups) => {
            !names::is_side_reading(&topic.channel.topic, topic.type_name())
                && command_split(topic, groups).0.iter().any(is_pose)
        }
        _ => false,
    };
    if found.iter().any(says) {
        return;
    }
    for (topic, guess) in found {
        let is_static = topic.channel.topic.ends_with("static");
        if is_static || topic.messages < 2 || topic.report.obstacle.is_some() {
            continue;
        }
        let decode = |sample: &bytes::Bytes| decode_to_json(&schema_of(&topic.channel), sample, library).ok();
        let messages: Vec<Value> = topic.samples.iter().filter_map(decode).collect();
        if let Some(groups) = transforms(topic, &messages) {
            *guess = Guess::Vectors(groups);
        }
    }
}

fn guess_topic(topic: &Topic, survey: &Survey, library: &SchemaLibrary) -> Guess {
    if let Some(obstacle) = &topic.report.obstacle {
        return Guess::Skip(obstacle.clone());
    }
    if topic.messages == 0 || topic.samples.is_empty() {
        return Guess::Skip("no messages".to_owned());
    }
    if names::is_housekeeping(&topic.channel.topic, topic.type_name()) {
        return Guess::Skip("says nothing of the state that suggest knows how to use".to_owned());
    }
    match is_camera(topic, library) {
        Some(Ok(size)) => return Guess::Camera(size),
        Some(Err(reason)) => return Guess::Skip(reason),
        None => {}
    }
    let mut failure = None;
    let mut messages: Vec<Value> = Vec::new();
    for sample in &topic.samples {
        match decode_to_json(&schema_of(&topic.channel), sample, library) {
            Ok(message) => messages.push(message),
            Err(error) => failure = Some(error.to_string()),
        }
    }
    if messages.is_empty() {
        return Guess::Skip(format!("no message could be decoded: {}", failure.unwrap_or_default()));
    }
    let groups = joints(topic, &messages, survey).unwrap_or_else(|| numbers(topic, &messages));
    if groups.is_empty() {
        Guess::Skip("holds no numbers of fixed number".to_owned())
    } else {
        Guess::Vectors(groups)
    }
}

/// Returns whether a topic holds images; an error when it does, of a kind that cannot be used.
fn is_camera(topic: &Topic, library: &SchemaLibrary) -> Option<Result<(u32, u32), String>> {
    let has_bytes = topic.fields.iter().any(|field| field.path.trim_end_matches("[]") == "data");
    if !has_bytes {
        return None;
    }
    let named = topic.type_name().rsplit(['/', '.']).next().unwrap_or("").ends_with("Image");
    let plan = match ImagePlan::compile(&schema_of(&topic.channel), library) {
        Ok(plan) => plan,
        Err(error) => {
            let is_video = topic.type_name().ends_with("CompressedVideo");
            return is_video.then(|| Err(error.to_string()));
        }
    };
    let mut last = None;
    for sample in &topic.samples {
        let message = plan.extract(sample, &mut RowSink::new());
        match message.map_err(|error| error.to_string()).and_then(|message| {
            let keep = |data: &[u8]| bytes::Bytes::copy_from_slice(data);
            Picture::new(&message, keep).map_err(|error| error.to_string())
        }) {
            Ok(picture) if picture.packet().is_some() => return Some(video_size(topic, &plan)),
            Ok(picture) => return Some(Ok(picture.recorded_size())),
            Err(error) => last = Some(error),
        }
    }
    named.then(|| Err(last.unwrap_or_else(|| "no image".to_owned())))
}

/// Returns the size of the first frame that the packets of a topic give.
fn video_size(topic: &Topic, plan: &ImagePlan) -> Result<(u32, u32), String> {
    let mut decoder: Option<PacketDecoder> = None;
    let mut last = "no frame".to_owned();
    for (number, sample) in topic.samples.iter().enumerate() {
        let mut sink = RowSink::new();
        let frames = plan.extract(sample, &mut sink).map_err(|error| error.to_string()).and_then(|message| {
            let opened = match decoder.take() {
                Some(decoder) => Ok(decoder),
                None => PacketDecoder::new(&message.format),
            };
            let pushed = opened.and_then(|mut opened| {
                let frames = opened.push(number as i64, &message.data);
                decoder = Some(opened);
                frames
            });
            pushed.map_err(|error| error.to_string())
        });
        match frames {
            Ok(frames) => {
                if let Some((_, frame)) = frames.first() {
                    return Ok((frame.width, frame.height));
                }
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}

fn base_stream(topic: &Topic, feature: &str, role: RoleSpec) -> (StreamSpec, Vec<String>) {
    let (clock, clock_reason) = clock_of(topic);
    let (tolerance_ms, rate_reason) = tolerance_of(topic);
    let stream = StreamSpec {
        name: None,
        topic: Some(topic.channel.topic.clone()),
        fields: Vec::new(),
        feature: feature.to_owned(),
        role: Some(role),
        clock,
        align: Some(if tolerance_ms.is_some() { AlignSpec::Asof } else { AlignSpec::Hold }),
        tolerance_ms,
        offset_ms: 0.0,
        gap: GapRule::Split,
        non_finite: crate::contract::NonFiniteRule::Mask,
        unit: None,
        kind: KindSpec::Linear,
        order: None,
        wrap: None,
        sequence: None,
        frame: None,
        limits: Vec::new(),
        names: Vec::new(),
        action: None,
        image: None,
    };
    let reasons = vec![
        format!("{}, {} messages", shown_type(topic), topic.messages),
        format!("clock: {clock_reason}"),
        format!("tolerance: {rate_reason}"),
    ];
    (stream, reasons)
}

fn add_groups(
    suggestion: &mut Suggestion,
    topic: &Topic,
    groups: &[Group],
    feature: &str,
    role: RoleSpec,
    why: &str,
) {
    for group in groups {
        let (mut stream, mut reasons) = base_stream(topic, feature, role);
        if group.share < 1.0
            && let Some(rate_hz) = publisher_rate_hz(topic, group)
        {
            let tolerance_ms = (3e3 / rate_hz).max(20.0).ceil();
            (stream.tolerance_ms, stream.align) = (Some(tolerance_ms), Some(AlignSpec::Asof));
            reasons.pop();
            reasons.push(format!("tolerance: about {rate_hz:.1} Hz from its publisher"));
        }
        if group.is_stamped {
            "stamp".clone_into(&mut stream.clock);
            reasons.retain(|reason| !reason.starts_with("clock: "));
            reasons.push("clock: the stamps of the elements, close to the log times".to_owned());
        }
        stream.fields.clone_from(&group.fields);
        stream.names.clone_from(&group.names);
        if group.names.is_empty() && matches!(group.fields.as_slice(), [field] if field == "data") {
            stream.names = vec![names::words(&topic.channel.topic).join("_")];
        }
        stream.kind = group.kind;
        stream.unit.clone_from(&group.unit);
        stream.limits.clone_from(&group.limits);
        stream.order = (group.kind == KindSpec::Quaternion).then(|| {
            if group.fields.first().is_some_and(|field| field.ends_with(".w") || names::says_wxyz(field)) {
                QuaternionOrder::Wxyz
            } else {
                QuaternionOrder::Xyzw
            }
        });
        if role == RoleSpec::Action {
            stream.action = Some(action_rule(ActionTimingSpec::InForce));
        }
        reasons.insert(0, why.to_owned());
        reasons.push(format!("kind: {}", group.reason));
        suggestion.contract.stream.push(stream);
        suggestion.stream_reasons.push(reasons);
    }
}

/// Returns the rate of a publisher that shares its topic with others, if all of them are steady.
fn publisher_rate_hz(topic: &Topic, group: &Group) -> Option<f64> {
    let span_s = (topic.report.end_ns? as f64 - topic.report.start_ns? as f64) / 1e9;
    let own = topic.report.messages as f64 * group.share;
    let rate_hz = (own - 1.0) / span_s;
    (own >= 8.0 && rate_hz > 0.0 && topic.slow_ms <= 8e3 / rate_hz).then_some(rate_hz)
}

pub(crate) fn action_rule(timing: ActionTimingSpec) -> ActionSpec {
    ActionSpec { timing, n: None, reduce: None, delta_frame: DeltaFrame::Base, from: None, derived: None }
}

/// Returns whether a topic, or some of its fields, are commands.
fn command_split(topic: &Topic, groups: &[Group]) -> (Vec<Group>, Vec<Group>) {
    if names::is_command(&topic.channel.topic) || names::is_command_type(topic.type_name()) {
        return (Vec::new(), groups.to_vec());
    }
    let (mut states, mut commands) = (Vec::new(), Vec::new());
    for group in groups {
        let (targets, measured): (Vec<String>, Vec<String>) =
            group.fields.iter().cloned().partition(|field| names::is_command(field));
        if !measured.is_empty() {
            states.push(Group { fields: measured, ..group.clone() });
        }
        if !targets.is_empty() {
            commands.push(Group { fields: targets, limits: Vec::new(), ..group.clone() });
        }
    }
    (states, commands)
}

fn add_states(suggestion: &mut Suggestion, survey: &Survey, found: &[(&Topic, Guess)]) {
    let mut measured: Vec<(&Topic, Vec<Group>)> = Vec::new();
    for (topic, guess) in found {
        if let Guess::Vectors(groups) = guess {
            let (states, _) = command_split(topic, groups);
            if !states.is_empty() {
                measured.push((topic, states));
            }
        }
    }
    let is_joints = |groups: &[Group]| groups.iter().any(|group| group.is_joints);
    let is_gripper = |topic: &Topic, groups: &[Group]| {
        names::is_gripper(&topic.channel.topic) && groups.iter().any(|group| group.kind == KindSpec::Gripper)
    };
    let has_joints = measured.iter().any(|(_, groups)| is_joints(groups));
    let is_side = |topic: &Topic| names::is_side_reading(&topic.channel.topic, topic.type_name());
    let has_more = measured.iter().any(|(topic, groups)| !is_side(topic) && !is_marker(groups, topic));
    let extra_span = 0.5 * (survey.span_ns.1 - survey.span_ns.0) as f64;
    let mut has_state = false;
    for (topic, groups) in &measured {
        let (state, why) = match () {
            () if is_marker(groups, topic) => {
                (None, "a flag that is switched at times: an annotation of each row")
            }
            () if names::is_reward(&topic.channel.topic) => {
                (None, "a reward by its name: an annotation of each row")
            }
            () if is_joints(groups) => (Some(()), "joint states are the state"),
            () if has_joints && is_gripper(topic, groups) => {
                (Some(()), "a gripper belongs to the state of the arm")
            }
            () if has_joints => (None, "beside the joint states: carried along, not a target"),
            () if has_more && is_side(topic) => {
                (None, "a reading of its surroundings or its supply: carried along, not a target")
            }
            () => (Some(()), "no joint states in this log: every number that is measured is state"),
        };
        let covers = (topic.span_ns.1 - topic.span_ns.0) as f64 >= extra_span;
        let feature = names::words(&topic.channel.topic).join("_");
        match state {
            Some(()) if has_joints || covers => {
                add_groups(suggestion, topic, groups, "observation.state", RoleSpec::State, why);
                has_state = true;
            }
            _ if !covers => suggestion.unmapped.push(format!(
                "{} ({}): {} messages that cover less than half of the log",
                topic.channel.topic,
                shown_type(topic),
                topic.messages
            )),
            _ if is_marker(groups, topic) || names::is_reward(&topic.channel.topic) => {
                if !names::is_recording(&topic.channel.topic) {
                    let feature = format!("annotation.{feature}");
                    let n_before = suggestion.contract.stream.len();
                    add_groups(suggestion, topic, groups, &feature, RoleSpec::Annotation, why);
                    // What is only carried along decides neither where rows begin nor where they end.
                    for stream in &mut suggestion.contract.stream[n_before..] {
                        stream.gap = GapRule::Mask;
                    }
                }
            }
            _ => add_groups(
                suggestion,
                topic,
                groups,
                &format!("observation.{feature}"),
                RoleSpec::Observation,
                why,
            ),
        }
    }
    let is_candidate = |(topic, _): &&(&Topic, Vec<Group>)| !names::is_reward(&topic.channel.topic);
    if !has_state
        && let Some((topic, groups)) =
            measured.iter().filter(is_candidate).max_by_key(|(topic, _)| topic.messages)
    {
        add_groups(
            suggestion,
            topic,
            groups,
            "observation.state",
            RoleSpec::State,
            "the topic with most messages",
        );
    }
}

/// A topic of a single truth value.
fn is_marker(groups: &[Group], topic: &Topic) -> bool {
    let bare = topic.type_name().rsplit(['/', '.']).next().unwrap_or("");
    bare == "Bool" || (groups.len() == 1 && groups[0].kind == KindSpec::Bool && groups[0].fields.len() == 1)
}

fn add_actions(suggestion: &mut Suggestion, found: &[(&Topic, Guess)]) {
    for (topic, guess) in found {
        let Guess::Vectors(groups) = guess else { continue };
        let (_, mut commands) = command_split(topic, groups);
        let name = format!("{} {}", topic.channel.topic, topic.type_name());
        if names::is_delta(&name) {
            for group in &mut commands {
                let is_angular = group.fields.iter().all(|field| field.contains("angular"));
                if is_angular && group.fields.len() == 3 {
                    group.kind = KindSpec::Rotvec;
                    group.unit = Some("rad".to_owned());
                    "a step of rotation, by the topic's name: a rotation vector"
                        .clone_into(&mut group.reason);
                } else if group.unit.as_deref() == Some("m/s") {
                    group.unit = Some("m".to_owned());
                    "a step of position, by the topic's name".clone_into(&mut group.reason);
                }
            }
        }
        add_groups(suggestion, topic, &commands, "action", RoleSpec::Action, "a command by its name");
    }
}

fn add_camera(suggestion: &mut Suggestion, topic: &Topic, info: Option<String>) {
    let generic =
        ["image", "compressed", "compresseddepth", "raw", "color", "rgb", "camera", "cam", "video", "format"];
    let words = names::words(&topic.channel.topic.replace("compressedDepth", "depth"));
    let mut kept: Vec<String> =
        words.iter().filter(|word| !generic.contains(&word.as_str())).cloned().collect();
    kept.dedup();
    let mut name = if kept.is_empty() { "camera".to_owned() } else { kept.join("_") };
    let taken = |name: &str, streams: &[StreamSpec]| {
        streams.iter().any(|stream| stream.feature == format!("observation.images.{name}"))
    };
    if taken(&name, &suggestion.contract.stream) {
        name = words.join("_");
    }
    let (mut stream, mut reasons) =
        base_stream(topic, &format!("observation.images.{name}"), RoleSpec::Image);
    if let Some(info) = &info {
        reasons.push(format!("calibration: {info}, the one nearest by its name, for images of this size"));
    }
    stream.image = Some(ImageSpec { camera_info: info, ..ImageSpec::default() });
    reasons.insert(0, "a camera by its type and content".to_owned());
    suggestion.contract.stream.push(stream);
    suggestion.stream_reasons.push(reasons);
}

/// Returns the calibration topic that shares most of the beginning of a camera's topic, of those for its size.
fn camera_info(topic: &Topic, size: (u32, u32), survey: &Survey, library: &SchemaLibrary) -> Option<String> {
    let levels = |name: &str| name.trim_matches('/').split('/').map(str::to_owned).collect::<Vec<_>>();
    let own = levels(&topic.channel.topic);
    let shared = |other: &str| levels(other).iter().zip(&own).take_while(|(a, b)| a == b).count();
    let infos = survey.topics.values().filter(|other| {
        let bare = other.type_name().rsplit(['/', '.']).next().unwrap_or("");
        let sample = other.samples.first().filter(|_| matches!(bare, "CameraInfo" | "CameraCalibration"));
        let info =
            sample.and_then(|sample| CameraInfo::decode(&schema_of(&other.channel), sample, library).ok());
        info.is_some_and(|info| (info.width, info.height) == size)
    });
    infos
        .map(|info| (shared(&info.channel.topic), info.channel.topic.clone()))
        .filter(|(n, _)| *n > 0)
        .max()
        .map(|(_, name)| name)
}

/// A log without commands gets actions made from the state.
fn add_derived(suggestion: &mut Suggestion) {
    let streams = &suggestion.contract.stream;
    let has_action = streams.iter().any(|stream| stream.role == Some(RoleSpec::Action));
    let has_state = streams.iter().any(|stream| stream.role == Some(RoleSpec::State));
    if has_action || !has_state {
        return;
    }
    let action = ActionSpec {
        from: Some("observation.state".to_owned()),
        derived: Some(DerivedSpec::Next),
        ..action_rule(ActionTimingSpec::Derived)
    };
    suggestion.contract.stream.push(StreamSpec {
        topic: None,
        action: Some(action),
        tolerance_ms: None,
        align: None,
        clock: "stamp".to_owned(),
        fields: Vec::new(),
        feature: "action".to_owned(),
        role: Some(RoleSpec::Action),
        kind: KindSpec::Linear,
        name: None,
        offset_ms: 0.0,
        gap: GapRule::Split,
        non_finite: crate::contract::NonFiniteRule::Mask,
        unit: None,
        order: None,
        wrap: None,
        sequence: None,
        frame: None,
        limits: Vec::new(),
        names: Vec::new(),
        image: None,
    });
    suggestion.stream_reasons.push(vec![
        "no command topic in the log: the action of a row is the state of the next one, marked as derived"
            .to_owned(),
    ]);
}

fn set_rate(suggestion: &mut Suggestion, survey: &Survey, found: &[(&Topic, Guess)]) {
    let rate_of = |stream: &StreamSpec| {
        let topic = survey.topics.get(stream.topic.as_deref()?)?;
        let own = found.iter().filter(|(other, _)| other.channel.topic == topic.channel.topic);
        let groups = own.filter_map(|(_, guess)| match guess {
            Guess::Vectors(groups) => Some(groups),
            _ => None,
        });
        let shared = groups.flatten().find(|group| group.share < 1.0 && group.fields == stream.fields);
        if let Some(group) = shared {
            return publisher_rate_hz(topic, group);
        }
        (topic.rate_hz() > 0.0 && stream.tolerance_ms.is_some()).then(|| topic.rate_hz())
    };
    let is_depth = |stream: &StreamSpec| stream.feature.contains("depth");
    let slowest = |role: RoleSpec| {
        let own = suggestion.contract.stream.iter().filter(|stream| stream.role == Some(role));
        let colour = own.clone().filter(|stream| !is_depth(stream)).filter_map(rate_of).reduce(f64::min);
        colour.or(own.filter_map(rate_of).reduce(f64::min))
    };
    let is_measured = |stream: &&StreamSpec| stream.role != Some(RoleSpec::Annotation);
    let fastest = suggestion.contract.stream.iter().filter(is_measured).filter_map(rate_of).reduce(f64::max);
    let (mut rate, mut reason) = match (slowest(RoleSpec::Image), slowest(RoleSpec::State)) {
        (Some(rate), _) => (rate, format!("the slowest camera has {rate:.3} Hz")),
        (None, Some(rate)) => (rate, format!("the slowest state stream has {rate:.3} Hz")),
        (None, None) => (fastest.unwrap_or(10.0), "no camera and no steady state stream".to_owned()),
    };
    if rate > MAX_RATE_HZ {
        reason.push_str(&format!(", brought down to {MAX_RATE_HZ} Hz"));
        rate = MAX_RATE_HZ;
    }
    let span_s = (survey.span_ns.1.saturating_sub(survey.span_ns.0)) as f64 / 1e9;
    if span_s > 0.0
        && span_s * rate < MIN_ROWS
        && let Some(fastest) = fastest.filter(|fastest| *fastest > rate)
    {
        let state = slowest(RoleSpec::State).unwrap_or(fastest);
        if state > rate {
            reason = format!("the log is {span_s:.2} s short, so the rate of the state: {state:.3} Hz");
            rate = state;
        }
    }
    // Integers are what LeRobot stores: a usual rate or the nearest where it is within 5 %, else the next below.
    let distance = |usual: &f64| (usual / rate - 1.0).abs();
    let nearest = USUAL_RATES_HZ.into_iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    let usual = nearest.filter(|usual| distance(usual) <= 0.05);
    let near = (rate.round() / rate - 1.0).abs() <= 0.05;
    let rounded = usual.unwrap_or(if near { rate.round() } else { rate.floor() });
    let (rate_hz, fps) =
        if rounded >= 1.0 { (rounded, None) } else { ((rate * 1e4).round().max(100.0) / 1e4, Some(1)) };
    suggestion.contract.ticks =
        TicksSpec { mode: TickMode::Fixed, rate_hz: Some(rate_hz), fps, stream: None };
    suggestion.reasons.insert("ticks", vec![reason]);
}

fn set_window(suggestion: &mut Suggestion, survey: &Survey) {
    let mut reasons = Vec::new();
    if survey.largest_disorder_ms > 0.0 {
        reasons.push(format!("messages come up to {:.1} ms out of order", survey.largest_disorder_ms));
    }
    let mut window = suggestion.contract.disorder_window_ms.max((survey.largest_disorder_ms * 1.5).ceil());
    if let Some(reset) = survey.smallest_reset_ms {
        reasons.push(format!("log times run back by {reset:.0} ms and more and go on from there: a clock that is reset, so the window must be smaller"));
        window = window.min((reset * 0.5).max(0.0));
    }
    suggestion.contract.disorder_window_ms = window;
    if !reasons.is_empty() {
        suggestion.reasons.insert("disorder_window_ms", reasons);
    }
}
