//! Which numbers of a message are columns, and what they are.

use std::collections::BTreeSet;

use serde_json::Value;

use super::guess::Group;
use super::survey::{Survey, Topic};
use super::{names, urdf};
use crate::contract::KindSpec;
use crate::decode::{FieldInfo, Scalar};

/// Widest feature that one topic may give.
const MAX_WIDTH: usize = 1024;

/// How a message pairs the names of joints with their positions.
#[derive(Debug, Clone, Copy, PartialEq)]
enum JointLayout<'a> {
    /// Two arrays.
    Parallel { key: &'static str, value: &'static str },
    /// An array of structs with `name` and `position`.
    Structs { list: &'a str },
    /// An array, and in the only struct of another the values, as in a trajectory of one point.
    Point { key: &'static str, list: &'static str, value: &'static str },
}

fn joint_layout(topic: &Topic) -> Option<JointLayout<'_>> {
    let has = |path: &str| topic.fields.iter().any(|field| field.path == path);
    let parallel =
        [("name", "position"), ("joint_names", "positions"), ("names", "positions"), ("name", "positions")];
    if let Some((key, value)) =
        parallel.into_iter().find(|(key, value)| has(&format!("{key}[]")) && has(&format!("{value}[]")))
    {
        return Some(JointLayout::Parallel { key, value });
    }
    if has("joint_names[]") && has("points[].positions[]") {
        return Some(JointLayout::Point { key: "joint_names", list: "points", value: "positions" });
    }
    topic.fields.iter().find_map(|field| {
        let list = field.path.strip_suffix("[].name")?;
        let is_plain = !list.contains(['.', '[']) && has(&format!("{list}[].position"));
        is_plain.then_some(JointLayout::Structs { list })
    })
}

/// Joint positions by name, when the message has parallel `name` and `position` arrays.
pub(crate) fn joints(topic: &Topic, messages: &[Value], survey: &Survey) -> Option<Vec<Group>> {
    let layout = joint_layout(topic)?;
    let names_of = |message: &Value| -> Option<Vec<String>> {
        let texts =
            |items: &[Value]| items.iter().filter_map(|name| name.as_str().map(str::to_owned)).collect();
        let names: Vec<String> = match layout {
            JointLayout::Parallel { key, value } => {
                let names = message.get(key)?.as_array()?;
                let values = message.get(value)?.as_array()?;
                if names.len() == values.len() { texts(names) } else { return None }
            }
            JointLayout::Point { key, list, value } => {
                let names = message.get(key)?.as_array()?;
                let [point] = message.get(list)?.as_array()?.as_slice() else { return None };
                let values = point.get(value)?.as_array()?;
                if names.len() == values.len() { texts(names) } else { return None }
            }
            JointLayout::Structs { list } => message
                .get(list)?
                .as_array()?
                .iter()
                .filter_map(|item| Some(item.get("name")?.as_str()?.to_owned()))
                .collect(),
        };
        (!names.is_empty()).then_some(names)
    };
    let all: Vec<Vec<String>> = messages.iter().filter_map(names_of).collect();
    let publishers = by_publisher(&all);
    let n_publishers = publishers.len();
    let mut groups = Vec::new();
    for names in publishers {
        let share = names.len() as f64 / all.len() as f64;
        for mut group in joints_of(&names, layout, survey)? {
            if n_publishers > 1 {
                group.share = share;
                group.reason.push_str(&format!("; one of {n_publishers} publishers of this topic"));
            }
            groups.push(group);
        }
    }
    (!groups.is_empty()).then_some(groups)
}

/// Shares out the names of messages by who published them: names that come in one message belong together.
fn by_publisher(all: &[Vec<String>]) -> Vec<Vec<Vec<String>>> {
    let mut publishers: Vec<(BTreeSet<&String>, Vec<Vec<String>>)> = Vec::new();
    for names in all {
        let mut own: (BTreeSet<&String>, Vec<Vec<String>>) = (names.iter().collect(), vec![names.clone()]);
        let (same, others) =
            publishers.into_iter().partition(|(known, _)| names.iter().any(|name| known.contains(name)));
        publishers = others;
        let same: Vec<(BTreeSet<&String>, Vec<Vec<String>>)> = same;
        for (known, messages) in same.into_iter().rev() {
            own.0.extend(known);
            own.1.splice(0..0, messages);
        }
        publishers.push(own);
    }
    publishers.sort_by(|a, b| a.0.cmp(&b.0));
    publishers.into_iter().map(|(_, messages)| messages).collect()
}

/// The joints of one publisher.
fn joints_of(all: &[Vec<String>], layout: JointLayout<'_>, survey: &Survey) -> Option<Vec<Group>> {
    // Now and then a message has some of the joints only.
    let longest = all.iter().map(Vec::len).max()?;
    let first = all.iter().find(|names| names.len() == longest)?;
    let is_usual =
        |name: &&String| is_most(all.iter().filter(|names| names.contains(name)).count(), all.len());
    let mut common: Vec<String> = first.iter().filter(is_usual).cloned().collect();
    common.dedup();
    let mut unique = common.clone();
    unique.sort();
    unique.dedup();
    if common.is_empty() || unique.len() != common.len() {
        return None;
    }
    let (known, order) = urdf::joints(&survey.urdf);
    let has_other_order = |names: &Vec<String>| {
        let kept: Vec<&String> = names.iter().filter(|name| common.contains(name)).collect();
        kept.len() == common.len() && kept.into_iter().ne(&common)
    };
    let is_shuffled = all.iter().any(has_other_order);
    if common.iter().all(|name| order.contains(name)) {
        common.sort_by_key(|name| order.iter().position(|other| other == name));
    } else if is_shuffled {
        common = unique;
    }
    let mut groups: Vec<Group> = Vec::new();
    for name in common {
        let joint = known.get(&name);
        let (kind, unit, reason) = match joint.map(|joint| joint.kind.as_str()) {
            Some("prismatic") if names::is_gripper(&name) => {
                (KindSpec::Gripper, "m", "prismatic in the URDF, and named as a gripper")
            }
            Some("prismatic") => (KindSpec::Linear, "m", "prismatic in the URDF"),
            Some(_) => (KindSpec::Angle, "rad", "revolute or continuous in the URDF"),
            None if names::is_gripper(&name) => {
                (KindSpec::Gripper, "m", "named as a gripper; no URDF says its unit")
            }
            None => {
                (KindSpec::Angle, "rad", "positions of joints are angles in rad unless a URDF says otherwise")
            }
        };
        let limits = joint.and_then(|joint| joint.limits);
        let quoted = name.replace('\\', "\\\\").replace('"', "\\\"");
        let field = match layout {
            JointLayout::Parallel { key, value } => format!("{value}[{key}=\"{quoted}\"]"),
            JointLayout::Structs { list } => format!("{list}[name=\"{quoted}\"].position"),
            JointLayout::Point { key, list, value } => format!("{list}[0].{value}[{key}=\"{quoted}\"]"),
        };
        let is_same = groups.last().is_some_and(|group| {
            group.kind == kind && group.reason == reason && group.limits.is_empty() == limits.is_none()
        });
        match groups.last_mut().filter(|_| is_same) {
            Some(group) => {
                group.fields.push(field);
                group.limits.extend(limits);
            }
            None => groups.push(Group {
                limits: limits.into_iter().collect(),
                is_joints: true,
                ..Group::new(vec![field], kind, Some(unit.to_owned()), reason.to_owned())
            }),
        }
    }
    Some(groups)
}

/// All numbers of a message that is no joint state: quaternions as such, arrays where their length is fixed.
pub(crate) fn numbers(topic: &Topic, messages: &[Value]) -> Vec<Group> {
    let mut groups: Vec<Group> = Vec::new();
    let mut width = 0;
    let fields: Vec<&FieldInfo> = topic
        .fields
        .iter()
        .filter(|field| field.scalar.is_some_and(|scalar| scalar != Scalar::Text))
        .filter(|field| !names::is_bookkeeping(&field.path))
        .filter(|field| !names::is_setting(topic.type_name(), &field.path))
        .collect();
    let mut at = 0;
    while at < fields.len() {
        let field = fields[at];
        if let Some((order, paths)) = quaternion_at(&fields[at..]) {
            at += 4;
            if !has_direction(&paths, messages) {
                continue;
            }
            let reason = format!("four numbers named x, y, z, w: a quaternion in {order} order");
            groups.push(Group::new(paths, KindSpec::Quaternion, None, reason));
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
        let (kind, unit, reason) = match quaternion_array(&path, n, messages) {
            Some(reason) => (KindSpec::Quaternion, None, reason),
            None => kind_of(topic, field),
        };
        match groups
            .last_mut()
            .filter(|group| group.kind == kind && group.unit == unit && group.reason == reason)
        {
            Some(group) => group.fields.push(path),
            None => groups.push(Group::new(vec![path], kind, unit, reason)),
        }
    }
    for group in
        groups.iter_mut().filter(|group| group.kind == KindSpec::Rotvec && group.fields.len() % 3 != 0)
    {
        group.kind = KindSpec::Linear;
        "no three numbers of a rotation vector".clone_into(&mut group.reason);
    }
    // A single text that holds JSON: its numbers, when all samples have them.
    if groups.is_empty() {
        groups.extend(json_in_text(topic, messages));
    }
    groups
}

/// Returns whether a quaternion is one in most messages: sensors that do not know theirs send zeros.
fn has_direction(paths: &[String], messages: &[Value]) -> bool {
    let is_zero = |message: &&Value| {
        paths.iter().all(|path| {
            crate::episodes::value_at(message, path)
                .is_none_or(|value| value.as_f64().is_none_or(|v| v == 0.0))
        })
    };
    is_most(messages.len() - messages.iter().filter(is_zero).count(), messages.len())
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

/// Returns why four numbers in an array are a quaternion, if they are.
fn quaternion_array(path: &str, n: usize, messages: &[Value]) -> Option<String> {
    let base = path.strip_suffix("[0:4]").filter(|_| n == 4)?;
    let last = base.rsplit('.').next().unwrap_or(base);
    let is_named = names::words(last)
        .iter()
        .any(|word| matches!(word.as_str(), "quat" | "quaternion" | "orientation" | "rotation"));
    let norm = |message: &Value| -> Option<f64> {
        let items = crate::episodes::value_at(message, base)?;
        let numbers: Option<Vec<f64>> = items.as_array()?.iter().map(Value::as_f64).collect();
        Some(numbers?.iter().map(|value| value * value).sum::<f64>().sqrt())
    };
    let unit = messages.iter().filter_map(norm).filter(|norm| (norm - 1.0).abs() < 0.01).count();
    let reason = if names::says_wxyz(base) {
        "four numbers of length 1 named as a quaternion in w, x, y, z order"
    } else if names::words(base).iter().any(|word| word == "xyzw") {
        "four numbers of length 1 named as a quaternion in x, y, z, w order"
    } else {
        "four numbers of length 1 named as a quaternion; that their order is x, y, z, w is a guess"
    };
    (is_named && is_most(unit, messages.len())).then(|| reason.to_owned())
}

/// Returns the number of values that most messages have in an array.
fn usual_length(messages: &[Value], length_in: impl Fn(&Value) -> Option<usize>) -> Option<usize> {
    let lengths: Vec<Option<usize>> = messages.iter().map(length_in).collect();
    let count = |n: usize| lengths.iter().filter(|other| **other == Some(n)).count();
    let n = lengths.iter().flatten().copied().max_by_key(|n| count(*n))?;
    (n > 0 && n <= MAX_WIDTH && is_most(count(n), lengths.len())).then_some(n)
}

/// Returns the path of a value in the structs of an array, or of an array in the only one of them.
fn path_in_structs(field: &FieldInfo, messages: &[Value]) -> Option<(String, usize)> {
    let (list, member) = field.path.split_once("[].")?;
    if member.contains("[].") || field.owner.ends_with("Quaternion") {
        return None;
    }
    let items = |message: &Value| -> Option<Vec<Value>> {
        crate::episodes::value_at(message, list)?.as_array().cloned()
    };
    let Some(inner) = member.strip_suffix("[]") else {
        let n = usual_length(messages, |message| {
            let items = items(message)?;
            let is_whole = |item| is_number(crate::episodes::value_at(item, member).as_ref());
            items.iter().all(is_whole).then_some(items.len())
        })?;
        return Some((format!("{list}[0:{n}].{member}"), n));
    };
    // A trajectory of one point is a command of that point.
    let n = usual_length(messages, |message| match items(message)?.as_slice() {
        [only] => {
            let values = crate::episodes::value_at(only, inner)?;
            let values = values.as_array()?;
            values.iter().all(|value| is_number(Some(value))).then_some(values.len())
        }
        _ => None,
    })?;
    Some((format!("{list}[0].{inner}[0:{n}]"), n))
}

/// Returns the path of a leaf that every message has, arrays of equal length as slices, and its number of values.
fn fixed_path(field: &FieldInfo, messages: &[Value]) -> Option<(String, usize)> {
    match field.arrays.as_slice() {
        [] => {
            let n = messages
                .iter()
                .filter(|message| is_number(crate::episodes::value_at(message, &field.path).as_ref()))
                .count();
            is_most(n, messages.len()).then(|| (field.path.clone(), 1))
        }
        [_] if field.path.ends_with("[]") => {
            let base = field.path.trim_end_matches("[]");
            let items = |message: &Value| crate::episodes::value_at(message, base)?.as_array().cloned();
            let n = usual_length(messages, |message| {
                let items = items(message)?;
                items.iter().all(|item| is_number(Some(item))).then_some(items.len())
            })?;
            // Ranges of a scanner are infinite where nothing is hit: no row of them could be used.
            let is_finite = |items: &Vec<Value>| items.iter().all(|item| !item.is_string());
            let finite = messages.iter().filter_map(items).filter(is_finite).count();
            is_most(finite, messages.len()).then(|| (format!("{base}[0:{n}]"), n))
        }
        _ => path_in_structs(field, messages),
    }
}

/// A few damaged messages do not decide what a topic is.
fn is_most(n: usize, all: usize) -> bool {
    n > 0 && 10 * n >= 8 * all
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
        let unit = if field.path.ends_with("_n") { Some("N") } else { names::unit_of(&field.path) };
        let unit = unit.map(str::to_owned);
        if unit.as_deref() != Some("N") {
            return (KindSpec::Gripper, unit, "named as a gripper".to_owned());
        }
        return (KindSpec::Linear, unit, "a force by its name".to_owned());
    }
    let bare = topic.type_name().rsplit(['/', '.']).next().unwrap_or("");
    if has("rotvec") || names::words(&topic.channel.topic).iter().any(|word| word == "rotvec") {
        return (KindSpec::Rotvec, some("rad"), "a rotation vector by its name".to_owned());
    }
    let is_pose = field.owner.ends_with("Point") || has("position") || has("translation");
    let unit = match () {
        () if has("angular") && (has("velocity") || bare.starts_with("Twist") || has("twist")) => {
            some("rad/s")
        }
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
        () => names::unit_of(&field.path).map(str::to_owned),
    };
    let reason =
        if unit.is_some() { "unit by type and name" } else { "unit unknown: say `unit` if you know it" };
    (KindSpec::Linear, unit, reason.to_owned())
}

fn json_in_text(topic: &Topic, messages: &[Value]) -> Option<Group> {
    let text_field =
        topic.fields.iter().find(|field| field.scalar == Some(Scalar::Text) && field.arrays.is_empty())?;
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
        let is_always =
            inner.iter().all(|other| other.get(name).is_some_and(|v| v.is_number() || v.is_boolean()));
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
    Some(Group::new(fields, kind, None, reason))
}
