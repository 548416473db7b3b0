//! Decides what each topic is.

use gawm_schema::QuaternionOrder;
use serde_json::Value;

use super::Suggestion;
use super::names;
use super::survey::{Survey, Topic};
use super::urdf;
use crate::contract::{
    ActionSpec, ActionTimingSpec, AlignSpec, Contract, DeltaFrame, DerivedSpec, GapRule, ImageSpec, KindSpec,
    RoleSpec, StreamSpec, TickMode, TicksSpec,
};
use crate::decode::{FieldInfo, ImagePlan, RowSink, Scalar, SchemaLibrary, decode_to_json};
use crate::run::{Picture, schema_of};

/// Widest feature that one topic may give.
const MAX_WIDTH: usize = 1024;
/// A stamp whose offset to the log time is larger, or spreads more, is not trusted to be the same clock.
const MAX_STAMP_OFFSET_MS: f64 = 2_000.0;
/// Ticks per second are not proposed above this: more rows than a model needs.
const MAX_RATE_HZ: f64 = 50.0;
/// Rows that a log should give at least.
const MIN_ROWS: f64 = 20.0;

/// What a topic was found to be.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Guess {
    Camera,
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
                let text = format!("{} messages in {} of {} logs", topic.messages, topic.recordings, survey.recordings);
                *guess = Guess::Skip(text);
            }
        }
    }
    for (topic, guess) in &found {
        if let Guess::Skip(reason) = guess {
            suggestion.unmapped.push(format!("{} ({}): {reason}", topic.channel.topic, shown_type(topic)));
        }
    }
    add_states(&mut suggestion, survey, &found);
    add_actions(&mut suggestion, &found);
    for (topic, _) in found.iter().filter(|(_, guess)| *guess == Guess::Camera) {
        add_camera(&mut suggestion, topic, survey);
    }
    add_derived(&mut suggestion);
    set_rate(&mut suggestion, survey);
    set_window(&mut suggestion, survey);
    suggestion
}

fn shown_type(topic: &Topic) -> String {
    let name = topic.type_name();
    if name.is_empty() { format!("{}, no schema", topic.channel.message_encoding) } else { name.to_owned() }
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
        Some(Ok(())) => return Guess::Camera,
        Some(Err(reason)) => return Guess::Skip(reason),
        None => {}
    }
    let messages: Vec<Value> = topic
        .samples
        .iter()
        .filter_map(|sample| decode_to_json(&schema_of(&topic.channel), sample, library).ok())
        .collect();
    if messages.is_empty() {
        return Guess::Skip("no message could be decoded".to_owned());
    }
    let groups = joints(topic, &messages, survey).unwrap_or_else(|| numbers(topic, &messages));
    if groups.is_empty() { Guess::Skip("holds no numbers of fixed number".to_owned()) } else { Guess::Vectors(groups) }
}

/// Returns whether a topic holds images; an error when it does, of a kind that cannot be used.
fn is_camera(topic: &Topic, library: &SchemaLibrary) -> Option<Result<(), String>> {
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
            Picture::new(&message, plan.kind(), keep).map_err(|error| error.to_string())
        }) {
            Ok(_) => return Some(Ok(())),
            Err(error) => last = Some(error),
        }
    }
    named.then(|| Err(last.unwrap_or_else(|| "no image".to_owned())))
}

/// Joint positions by name, when the message has parallel `name` and `position` arrays.
fn joints(topic: &Topic, messages: &[Value], survey: &Survey) -> Option<Vec<Group>> {
    let has = |path: &str| topic.fields.iter().any(|field| field.path == path);
    let (key, value) = [("name", "position"), ("joint_names", "positions"), ("names", "positions"), ("name", "positions")]
        .into_iter()
        .find(|(key, value)| has(&format!("{key}[]")) && has(&format!("{value}[]")))?;
    let names_of = |message: &Value| -> Option<Vec<String>> {
        let names = message.get(key)?.as_array()?;
        let values = message.get(value)?.as_array()?;
        let names: Vec<String> = names.iter().filter_map(|name| name.as_str().map(str::to_owned)).collect();
        (names.len() == values.len() && !names.is_empty()).then_some(names)
    };
    let all: Vec<Vec<String>> = messages.iter().filter_map(names_of).collect();
    let first = all.first()?;
    let mut common: Vec<String> =
        first.iter().filter(|name| all.iter().all(|names| names.contains(name))).cloned().collect();
    common.dedup();
    let mut unique = common.clone();
    unique.sort();
    unique.dedup();
    if common.is_empty() || unique.len() != common.len() {
        return None;
    }
    let (known, order) = urdf::joints(&survey.urdf);
    let is_shuffled = all.iter().any(|names| names != first);
    if common.iter().all(|name| order.contains(name)) {
        common.sort_by_key(|name| order.iter().position(|other| other == name));
    } else if is_shuffled {
        common = unique;
    }
    let mut groups: Vec<Group> = Vec::new();
    for name in common {
        let joint = known.get(&name);
        let (kind, unit, reason) = match joint.map(|joint| joint.kind.as_str()) {
            Some("prismatic") if names::is_gripper(&name) => (KindSpec::Gripper, "m", "prismatic in the URDF, and named as a gripper"),
            Some("prismatic") => (KindSpec::Linear, "m", "prismatic in the URDF"),
            Some(_) => (KindSpec::Angle, "rad", "revolute or continuous in the URDF"),
            None if names::is_gripper(&name) => (KindSpec::Gripper, "m", "named as a gripper; no URDF says its unit"),
            None => (KindSpec::Angle, "rad", "positions of joints are angles in rad unless a URDF says otherwise"),
        };
        let limits = joint.and_then(|joint| joint.limits);
        let field = format!("{value}[{key}=\"{}\"]", name.replace('\\', "\\\\").replace('"', "\\\""));
        let is_same = groups.last().is_some_and(|group| {
            group.kind == kind && group.reason == reason && group.limits.is_empty() == limits.is_none()
        });
        match groups.last_mut().filter(|_| is_same) {
            Some(group) => {
                group.fields.push(field);
                group.limits.extend(limits);
            }
            None => groups.push(Group {
                fields: vec![field],
                kind,
                unit: Some(unit.to_owned()),
                limits: limits.into_iter().collect(),
                reason: reason.to_owned(),
                is_joints: true,
            }),
        }
    }
    Some(groups)
}

/// All numbers of a message that is no joint state: quaternions as such, arrays where their length is fixed.
fn numbers(topic: &Topic, messages: &[Value]) -> Vec<Group> {
    let mut groups: Vec<Group> = Vec::new();
    let mut width = 0;
    let fields: Vec<&FieldInfo> = topic
        .fields
        .iter()
        .filter(|field| field.scalar.is_some_and(|scalar| scalar != Scalar::Text))
        .filter(|field| !names::is_bookkeeping(&field.path))
        .collect();
    let mut at = 0;
    while at < fields.len() {
        let field = fields[at];
        if let Some((order, paths)) = quaternion_at(&fields[at..]) {
            groups.push(Group {
                fields: paths,
                kind: KindSpec::Quaternion,
                unit: None,
                limits: Vec::new(),
                reason: format!("four numbers named x, y, z, w: a quaternion in {order} order"),
                is_joints: false,
            });
            at += 4;
            width += 4;
            continue;
        }
        at += 1;
        let Some(expanded) = fixed_path(field, messages) else { continue };
        let (path, n) = expanded;
        width += n;
        if width > MAX_WIDTH {
            break;
        }
        let (kind, unit, reason) = kind_of(topic, field);
        match groups.last_mut().filter(|group| group.kind == kind && group.unit == unit && group.reason == reason) {
            Some(group) => group.fields.push(path),
            None => groups.push(Group { fields: vec![path], kind, unit, limits: Vec::new(), reason, is_joints: false }),
        }
    }
    // A single text that holds JSON: its numbers, when all samples have them.
    if groups.is_empty() {
        groups.extend(json_in_text(topic, messages));
    }
    groups
}

fn quaternion_at(fields: &[&FieldInfo]) -> Option<(&'static str, Vec<String>)> {
    let four = fields.get(..4)?;
    let parent = four[0].path.rsplit_once('.')?.0;
    if parent.contains("[]") {
        return None;
    }
    let mut leaves = Vec::new();
    for field in four {
        let (other, leaf) = field.path.rsplit_once('.')?;
        if other != parent {
            return None;
        }
        leaves.push(leaf);
    }
    let order = match leaves.as_slice() {
        ["x", "y", "z", "w"] => "xyzw",
        ["w", "x", "y", "z"] => "wxyz",
        _ => return None,
    };
    Some((order, four.iter().map(|field| field.path.clone()).collect()))
}

/// Returns the path of a leaf that every message has, arrays of equal length as slices, and its number of values.
fn fixed_path(field: &FieldInfo, messages: &[Value]) -> Option<(String, usize)> {
    match field.arrays.as_slice() {
        [] => {
            let is_there = messages.iter().all(|message| is_number(crate::episodes::value_at(message, &field.path).as_ref()));
            is_there.then(|| (field.path.clone(), 1))
        }
        [_] if field.path.ends_with("[]") => {
            let base = field.path.trim_end_matches("[]");
            let lengths: Vec<Option<usize>> = messages
                .iter()
                .map(|message| {
                    let items = crate::episodes::value_at(message, base)?;
                    let items = items.as_array()?;
                    items.iter().all(|item| is_number(Some(item))).then_some(items.len())
                })
                .collect();
            let n = (*lengths.first()?)?;
            (n > 0 && n <= MAX_WIDTH && lengths.iter().all(|length| *length == Some(n)))
                .then(|| (format!("{base}[0:{n}]"), n))
        }
        _ => None,
    }
}

/// Numbers, truth values, and the texts that stand for numbers which JSON does not have.
fn is_number(value: Option<&Value>) -> bool {
    match value {
        Some(Value::Number(_) | Value::Bool(_)) => true,
        Some(Value::String(text)) => matches!(text.as_str(), "NaN" | "Infinity" | "-Infinity"),
        _ => false,
    }
}

fn kind_of(topic: &Topic, field: &FieldInfo) -> (KindSpec, Option<String>, String) {
    let some = |unit: &str| Some(unit.to_owned());
    let words = super::names::words(&field.path);
    let has = |word: &str| words.iter().any(|other| other == word);
    if field.scalar == Some(Scalar::Bool) {
        return (KindSpec::Bool, None, "truth values".to_owned());
    }
    if names::is_gripper(&field.path) || names::is_gripper(&topic.channel.topic) {
        let unit = if field.path.ends_with("_m") { some("m") } else if field.path.ends_with("_n") { some("N") } else { None };
        if unit.as_deref() != Some("N") {
            return (KindSpec::Gripper, unit, "named as a gripper".to_owned());
        }
        return (KindSpec::Linear, unit, "a force by its name".to_owned());
    }
    let bare = topic.type_name().rsplit(['/', '.']).next().unwrap_or("");
    let is_pose = field.owner.ends_with("Point") || has("position") || has("translation");
    let unit = match () {
        () if has("angular") && (has("velocity") || bare.starts_with("Twist") || has("twist")) => some("rad/s"),
        () if has("acceleration") => some("m/s^2"),
        () if has("linear") && (has("velocity") || bare.starts_with("Twist") || has("twist")) => some("m/s"),
        () if is_pose && field.path.ends_with(['x', 'y', 'z']) => some("m"),
        () if has("angle") && !has("velocity") => {
            return (KindSpec::Angle, some("rad"), "an angle by its name".to_owned());
        }
        () if field.path.ends_with("_rad") => {
            return (KindSpec::Angle, some("rad"), "an angle by its name".to_owned());
        }
        () if field.path.ends_with("_deg") => {
            return (KindSpec::Angle, some("deg"), "an angle by its name".to_owned());
        }
        () if field.path.ends_with("_m") => some("m"),
        () => None,
    };
    let reason = if unit.is_some() { "unit by type and name" } else { "unit unknown: say `unit` if you know it" };
    (KindSpec::Linear, unit, reason.to_owned())
}

fn json_in_text(topic: &Topic, messages: &[Value]) -> Option<Group> {
    let text_field = topic.fields.iter().find(|field| field.scalar == Some(Scalar::Text) && field.arrays.is_empty())?;
    let parse = |message: &Value| -> Option<Value> {
        let text = crate::episodes::value_at(message, &text_field.path)?;
        serde_json::from_str(text.as_str()?).ok()
    };
    let inner: Option<Vec<Value>> = messages.iter().map(parse).collect();
    let inner = inner?;
    let first = inner.first()?.as_object()?;
    let mut fields = Vec::new();
    for (name, value) in first {
        let is_plain = name.chars().all(|c| c.is_alphanumeric() || c == '_');
        let is_always = inner.iter().all(|other| other.get(name).is_some_and(|v| v.is_number() || v.is_boolean()));
        if is_plain && is_always && value.is_number() && !names::is_bookkeeping(name) {
            fields.push(format!("{}.{name}", text_field.path));
        }
    }
    let is_event = ["event", "state", "type"].iter().any(|key| first.get(*key).is_some_and(Value::is_string));
    if fields.is_empty() || is_event {
        return None;
    }
    let reason = "numbers of the JSON that the text holds".to_owned();
    let kind = if names::is_gripper(&topic.channel.topic) { KindSpec::Gripper } else { KindSpec::Linear };
    Some(Group { fields, kind, unit: None, limits: Vec::new(), reason, is_joints: false })
}

/// Returns the clock of a topic and why.
pub(crate) fn clock_of(topic: &Topic) -> (String, String) {
    let report = &topic.report;
    if report.stamps == report.messages && report.messages > 0 {
        match &report.stamp_to_log {
            Some(offset) => {
                let spread = offset.p95_ms - offset.p05_ms;
                if offset.median_ms.abs() <= MAX_STAMP_OFFSET_MS && spread <= MAX_STAMP_OFFSET_MS {
                    let reason = format!(
                        "header stamps, {:.1} ms before the log time (5 % to 95 %: {:.1} to {:.1} ms)",
                        offset.median_ms, offset.p05_ms, offset.p95_ms
                    );
                    return ("stamp".to_owned(), reason);
                }
                let reason = format!(
                    "log time: header stamps are {:.0} ms off it (5 % to 95 %: {:.0} to {:.0} ms), so not of the same clock",
                    offset.median_ms, offset.p05_ms, offset.p95_ms
                );
                return publish_or_log(topic, reason);
            }
            None if report.messages == 1 => return ("stamp".to_owned(), "one message, with a header stamp".to_owned()),
            None => {}
        }
    }
    publish_or_log(topic, "log time: no header stamp".to_owned())
}

fn publish_or_log(topic: &Topic, otherwise: String) -> (String, String) {
    match &topic.report.publish_to_log {
        Some(offset)
            if topic.report.has_publish_clock
                && offset.median_ms.abs() <= MAX_STAMP_OFFSET_MS
                && offset.p95_ms - offset.p05_ms <= MAX_STAMP_OFFSET_MS =>
        {
            let reason = format!("publish time, {:.1} ms before the log time; no usable header stamp", offset.median_ms);
            ("publish".to_owned(), reason)
        }
        _ => ("log".to_owned(), otherwise),
    }
}

/// Returns a tolerance and why, or none for topics that speak when something happens.
pub(crate) fn tolerance_of(topic: &Topic) -> (Option<f64>, String) {
    let rate = topic.rate_hz();
    let period = if rate > 0.0 { 1e3 / rate } else { 0.0 };
    let is_regular = topic.messages >= 8 && period > 0.0 && topic.slow_ms() <= 8.0 * period;
    if !is_regular {
        return (None, format!("{} messages at no steady rate: the last one holds", topic.messages));
    }
    let ms = (3.0 * period).max(2.0 * topic.slow_ms()).max(20.0);
    let ms = if ms < 1000.0 { ms.ceil() } else { (ms / 100.0).ceil() * 100.0 };
    (Some(ms), format!("{rate:.4} Hz, 1 % of the intervals over {:.1} ms", topic.slow_ms()))
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
    let reasons =
        vec![format!("{}, {} messages", shown_type(topic), topic.messages), format!("clock: {clock_reason}"), format!("tolerance: {rate_reason}")];
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
        stream.fields.clone_from(&group.fields);
        stream.kind = group.kind;
        stream.unit.clone_from(&group.unit);
        stream.limits.clone_from(&group.limits);
        stream.order = (group.kind == KindSpec::Quaternion).then(|| {
            if group.fields.first().is_some_and(|field| field.ends_with(".w")) { QuaternionOrder::Wxyz } else { QuaternionOrder::Xyzw }
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

pub(crate) fn action_rule(timing: ActionTimingSpec) -> ActionSpec {
    ActionSpec { timing, n: None, reduce: None, delta_frame: DeltaFrame::Base, from: None, derived: None }
}

/// Returns whether a topic, or some of its fields, are commands.
fn command_split(topic: &Topic, groups: &[Group]) -> (Vec<Group>, Vec<Group>) {
    if names::is_command(&topic.channel.topic) || names::is_command(topic.type_name().rsplit(['/', '.']).next().unwrap_or("")) {
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
    let extra_span = 0.5 * (survey.span_ns.1 - survey.span_ns.0) as f64;
    let mut has_state = false;
    for (topic, groups) in &measured {
        let (state, why) = match () {
            () if is_marker(groups, topic) => (None, "a flag that is switched at times: an annotation of each row"),
            () if is_joints(groups) => (Some(()), "joint states are the state"),
            () if has_joints && is_gripper(topic, groups) => (Some(()), "a gripper belongs to the state of the arm"),
            () if has_joints => (None, "beside the joint states: carried along, not a target"),
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
                topic.channel.topic, shown_type(topic), topic.messages
            )),
            _ if is_marker(groups, topic) => {
                if !names::is_recording(&topic.channel.topic) {
                    let feature = format!("annotation.{feature}");
                    add_groups(suggestion, topic, groups, &feature, RoleSpec::Annotation, why);
                }
            }
            _ => add_groups(suggestion, topic, groups, &format!("observation.{feature}"), RoleSpec::Observation, why),
        }
    }
    if !has_state && let Some((topic, groups)) = measured.iter().max_by_key(|(topic, _)| topic.messages) {
        add_groups(suggestion, topic, groups, "observation.state", RoleSpec::State, "the topic with most messages");
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
                    "a step of rotation, by the topic's name: a rotation vector".clone_into(&mut group.reason);
                } else if group.unit.as_deref() == Some("m/s") {
                    group.unit = Some("m".to_owned());
                    "a step of position, by the topic's name".clone_into(&mut group.reason);
                }
            }
        }
        add_groups(suggestion, topic, &commands, "action", RoleSpec::Action, "a command by its name");
    }
}

fn add_camera(suggestion: &mut Suggestion, topic: &Topic, survey: &Survey) {
    let generic = ["image", "compressed", "raw", "color", "rgb", "camera", "cam", "video"];
    let words = names::words(&topic.channel.topic);
    let kept: Vec<String> = words.iter().filter(|word| !generic.contains(&word.as_str())).cloned().collect();
    let mut name = if kept.is_empty() { "camera".to_owned() } else { kept.join("_") };
    let taken = |name: &str, streams: &[StreamSpec]| {
        streams.iter().any(|stream| stream.feature == format!("observation.images.{name}"))
    };
    if taken(&name, &suggestion.contract.stream) {
        name = words.join("_");
    }
    let (mut stream, mut reasons) = base_stream(topic, &format!("observation.images.{name}"), RoleSpec::Image);
    let info = camera_info(topic, survey);
    if let Some(info) = &info {
        reasons.push(format!("calibration: {info}, the one nearest by its name"));
    }
    stream.image = Some(ImageSpec { camera_info: info, ..ImageSpec::default() });
    reasons.insert(0, "a camera by its type and content".to_owned());
    suggestion.contract.stream.push(stream);
    suggestion.stream_reasons.push(reasons);
}

/// Returns the calibration topic that shares most of the beginning of a camera's topic.
fn camera_info(topic: &Topic, survey: &Survey) -> Option<String> {
    let levels = |name: &str| name.trim_matches('/').split('/').map(str::to_owned).collect::<Vec<_>>();
    let own = levels(&topic.channel.topic);
    let shared = |other: &str| levels(other).iter().zip(&own).take_while(|(a, b)| a == b).count();
    let infos = survey.topics.values().filter(|other| {
        let bare = other.type_name().rsplit(['/', '.']).next().unwrap_or("");
        matches!(bare, "CameraInfo" | "CameraCalibration")
    });
    infos.map(|info| (shared(&info.channel.topic), info.channel.topic.clone())).filter(|(n, _)| *n > 0).max().map(|(_, name)| name)
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
        "no command topic in the log: the action of a row is the state of the next one, marked as derived".to_owned(),
    ]);
}

fn set_rate(suggestion: &mut Suggestion, survey: &Survey) {
    let rate_of = |stream: &StreamSpec| {
        let topic = survey.topics.get(stream.topic.as_deref()?)?;
        (topic.rate_hz() > 0.0 && stream.tolerance_ms.is_some()).then(|| topic.rate_hz())
    };
    let slowest = |role: RoleSpec| {
        let rates = suggestion.contract.stream.iter().filter(|stream| stream.role == Some(role)).filter_map(rate_of);
        rates.reduce(f64::min)
    };
    let fastest = suggestion.contract.stream.iter().filter_map(rate_of).reduce(f64::max);
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
    if span_s > 0.0 && span_s * rate < MIN_ROWS && let Some(fastest) = fastest.filter(|fastest| *fastest > rate) {
        let state = slowest(RoleSpec::State).unwrap_or(fastest);
        if state > rate {
            reason = format!("the log is {span_s:.2} s short, so the rate of the state: {state:.3} Hz");
            rate = state;
        }
    }
    // Integers are what LeRobot stores: the nearest where it is within 5 %, else the next below.
    let rounded = if (rate.round() / rate - 1.0).abs() <= 0.05 { rate.round() } else { rate.floor() };
    let (rate_hz, fps) = if rounded >= 1.0 { (rounded, None) } else { ((rate * 1e4).round().max(100.0) / 1e4, Some(1)) };
    suggestion.contract.ticks = TicksSpec { mode: TickMode::Fixed, rate_hz: Some(rate_hz), fps, stream: None };
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
