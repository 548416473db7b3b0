//! Guesses where episodes begin and end, and what is said about them.

use serde_json::Value;

use super::Suggestion;
use super::names;
use super::survey::{Survey, Topic};
use crate::contract::{
    EpisodeSource, EpisodesSpec, LabelSource, MarkerValue, MetadataLabel, TimeUnit, TopicLabel,
};
use crate::decode::{Scalar, SchemaLibrary, decode_to_json};
use crate::run::schema_of;

/// Fills in episodes and labels.
pub(crate) fn guess(suggestion: &mut Suggestion, survey: &Survey) {
    let mut reasons = Vec::new();
    let found = from_metadata(survey).or_else(|| from_marker(survey));
    match found {
        Some((spec, reason)) => {
            suggestion.contract.episodes = spec;
            reasons.push(reason);
        }
        None => {
            reasons.push("no episode marks found: each recording is one episode, split at gaps".to_owned())
        }
    }
    if let (EpisodeSource::Marker, Some(topic)) =
        (suggestion.contract.episodes.from, &suggestion.contract.episodes.topic)
    {
        remove_topic(suggestion, &topic.clone());
    }
    suggestion.reasons.insert("episodes", reasons);
    labels(suggestion, survey);
}

/// A topic that marks episodes is no column.
fn remove_topic(suggestion: &mut Suggestion, topic: &str) {
    let streams = &suggestion.contract.stream;
    let kept: Vec<usize> =
        (0..streams.len()).filter(|&at| streams[at].topic.as_deref() != Some(topic)).collect();
    if !kept.is_empty() && kept.len() < streams.len() {
        suggestion.contract.stream = kept.iter().map(|&at| suggestion.contract.stream[at].clone()).collect();
        suggestion.stream_reasons = kept.iter().map(|&at| suggestion.stream_reasons[at].clone()).collect();
    }
}

/// Metadata records with a start and an end time within the log.
fn from_metadata(survey: &Survey) -> Option<(EpisodesSpec, String)> {
    for (name, values) in &survey.metadata {
        for (unit, scale) in [(TimeUnit::Ns, 1.0), (TimeUnit::S, 1e9)] {
            let time = |words: [&str; 3]| {
                values.iter().find_map(|(key, text)| {
                    let key_words = names::words(key);
                    let ns = text.trim().parse::<f64>().ok()? * scale;
                    let is_within =
                        ns >= survey.span_ns.0 as f64 - 1e9 && ns <= survey.span_ns.1 as f64 + 1e9;
                    (is_within && words.iter().any(|word| key_words.iter().any(|other| other == word)))
                        .then(|| (key.clone(), ns))
                })
            };
            let (Some(start), Some(end)) = (time(["start", "begin", "from"]), time(["end", "stop", "to"]))
            else {
                continue;
            };
            if start.1 >= end.1 {
                continue;
            }
            let n = survey.metadata.iter().filter(|(other, _)| other == name).count();
            let spec = EpisodesSpec {
                from: EpisodeSource::Metadata,
                record: Some(name.clone()),
                start_key: Some(start.0),
                end_key: Some(end.0),
                time_unit: unit,
                ..EpisodesSpec::default()
            };
            return Some((
                spec,
                format!("{n} metadata records {name:?} hold start and end times within the log"),
            ));
        }
    }
    None
}

fn from_marker(survey: &Survey) -> Option<(EpisodesSpec, String)> {
    let library = SchemaLibrary::builtin();
    let by_event = survey.topics.values().find_map(|topic| event_marker(topic, &library));
    by_event.or_else(|| survey.topics.values().find_map(|topic| flag_marker(topic, &library)))
}

fn messages(topic: &Topic, library: &SchemaLibrary) -> Vec<Value> {
    let decode = |sample: &bytes::Bytes| decode_to_json(&schema_of(&topic.channel), sample, library).ok();
    topic.samples.iter().filter_map(decode).collect()
}

/// A topic of texts that say `start` and `end`, plain or in JSON.
fn event_marker(topic: &Topic, library: &SchemaLibrary) -> Option<(EpisodesSpec, String)> {
    let texts: Vec<&str> = topic
        .fields
        .iter()
        .filter(|f| f.scalar == Some(Scalar::Text) && f.arrays.is_empty())
        .map(|f| f.path.as_str())
        .collect();
    if texts.is_empty() || topic.messages > 100_000 {
        return None;
    }
    let messages = messages(topic, library);
    let mut paths: Vec<String> = texts.iter().map(|path| (*path).to_owned()).collect();
    for path in &texts {
        for key in ["event", "state", "status", "type", "phase", "action"] {
            paths.push(format!("{path}.{key}"));
        }
    }
    let starts = ["start", "started", "begin", "episode_start", "start_episode", "recording_started"];
    let stops = [
        "end",
        "stop",
        "stopped",
        "finish",
        "finished",
        "done",
        "episode_end",
        "end_episode",
        "recording_stopped",
    ];
    for path in paths {
        let said: Vec<String> = messages
            .iter()
            .filter_map(|message| crate::episodes::value_at(message, &path)?.as_str().map(str::to_owned))
            .collect();
        let pick = |wanted: &[&str]| {
            said.iter().find(|text| wanted.contains(&text.to_lowercase().as_str())).cloned()
        };
        if let Some(start) = pick(&starts) {
            let stop = pick(&stops);
            let spec = EpisodesSpec {
                from: EpisodeSource::Marker,
                topic: Some(topic.channel.topic.clone()),
                field: Some(path),
                start: Some(MarkerValue::Text(start.clone())),
                stop: Some(MarkerValue::Text(stop.clone().unwrap_or_else(|| "end".to_owned()))),
                ..EpisodesSpec::default()
            };
            let shown = stop.map_or_else(|| "and no end".to_owned(), |stop| format!("and {stop:?}"));
            return Some((spec, format!("{} says {start:?} {shown}", topic.channel.topic)));
        }
    }
    None
}

/// A flag whose name says that something is recorded.
fn flag_marker(topic: &Topic, library: &SchemaLibrary) -> Option<(EpisodesSpec, String)> {
    let mut flags =
        topic.fields.iter().filter(|field| field.scalar == Some(Scalar::Bool) && field.arrays.is_empty());
    let flag = flags.next()?;
    let is_named = names::is_recording(&topic.channel.topic) || names::is_recording(&flag.path);
    let ever_true = messages(topic, library)
        .iter()
        .any(|message| crate::episodes::value_at(message, &flag.path) == Some(Value::Bool(true)));
    // A flag that is sent all the time would open an episode with every message.
    if !is_named || !ever_true || topic.messages > 2000 {
        return None;
    }
    let spec = EpisodesSpec {
        from: EpisodeSource::Marker,
        topic: Some(topic.channel.topic.clone()),
        field: Some(flag.path.clone()),
        start: Some(MarkerValue::Bool(true)),
        stop: Some(MarkerValue::Bool(false)),
        ..EpisodesSpec::default()
    };
    Some((spec, format!("{} is true while an episode is recorded, by its name", topic.channel.topic)))
}

fn labels(suggestion: &mut Suggestion, survey: &Survey) {
    let mut reasons = Vec::new();
    let keys: [(&str, &[&str]); 5] = [
        ("task", &["task", "instruction", "language_instruction", "prompt", "task_description", "task_name"]),
        ("success", &["success", "successful", "outcome", "is_success"]),
        ("operator", &["operator", "user", "teleoperator"]),
        ("robot", &["robot", "robot_id", "robot_name", "robot_type"]),
        ("session", &["session", "session_id"]),
    ];
    let record = suggestion.contract.episodes.record.clone();
    for (label, wanted) in keys {
        let own = survey.metadata.iter().find(|(name, values)| {
            Some(name) == record.as_ref() && wanted.iter().any(|key| values.contains_key(*key))
        });
        let any =
            survey.metadata.iter().find(|(_, values)| wanted.iter().any(|key| values.contains_key(*key)));
        let source = own.or(any).and_then(|(name, values)| {
            let key = wanted.iter().find(|key| values.contains_key(**key))?;
            Some(LabelSource::Metadata(MetadataLabel { metadata: name.clone(), key: (*key).to_owned() }))
        });
        let source = source
            .or_else(|| topic_label(label, suggestion, survey))
            .or_else(|| marker_label(wanted, suggestion, survey));
        if let Some(source) = source {
            reasons.push(format!("{label}: found {}", shown(&source)));
            let slot = &mut suggestion.contract.labels;
            match label {
                "task" => slot.task = Some(source),
                "success" => slot.success = Some(source),
                "operator" => slot.operator = Some(source),
                "robot" => slot.robot = Some(source),
                _ => slot.session = Some(source),
            }
        }
    }
    if suggestion.contract.labels.task.is_none() {
        suggestion.contract.labels.task = Some(LabelSource::Constant("no task given".to_owned()));
        reasons.push(
            "task: nothing in the log says it; write what the robot does, policies are told this text"
                .to_owned(),
        );
    }
    suggestion.reasons.insert("labels", reasons);
}

/// A text beside what marks the episodes.
fn marker_label(wanted: &[&str], suggestion: &Suggestion, survey: &Survey) -> Option<LabelSource> {
    let marker = suggestion.contract.episodes.topic.as_ref()?;
    let field = suggestion.contract.episodes.field.as_ref()?;
    let messages = messages(survey.topics.get(marker)?, &SchemaLibrary::builtin());
    let beside = |key: &str| match field.rsplit_once('.') {
        Some((parent, _)) => format!("{parent}.{key}"),
        None => key.to_owned(),
    };
    let is_text = |path: &String| {
        messages.iter().any(|m| crate::episodes::value_at(m, path).is_some_and(|value| value.is_string()))
    };
    let field = wanted.iter().map(|key| beside(key)).find(is_text)?;
    Some(LabelSource::Topic(TopicLabel { topic: marker.clone(), field }))
}

fn shown(source: &LabelSource) -> String {
    match source {
        LabelSource::Metadata(label) => format!("in the metadata record {:?}", label.metadata),
        LabelSource::Topic(label) => format!("on {}", label.topic),
        _ => "as given".to_owned(),
    }
}

fn topic_label(label: &str, suggestion: &Suggestion, survey: &Survey) -> Option<LabelSource> {
    let library = SchemaLibrary::builtin();
    if label == "task" {
        let topic = survey.topics.values().find(|topic| {
            names::is_task(&topic.channel.topic)
                && topic
                    .fields
                    .iter()
                    .any(|f| f.scalar == Some(Scalar::Text) && f.arrays.is_empty() && f.path == "data")
        })?;
        return Some(LabelSource::Topic(TopicLabel {
            topic: topic.channel.topic.clone(),
            field: "data".to_owned(),
        }));
    }
    if label == "success" {
        let marker = suggestion.contract.episodes.topic.as_ref()?;
        let topic = survey.topics.get(marker)?;
        let field = suggestion.contract.episodes.field.as_ref()?;
        let parent = field.rsplit_once('.').map_or("", |(parent, _)| parent);
        let path = if parent.is_empty() { "success".to_owned() } else { format!("{parent}.success") };
        let is_there =
            messages(topic, &library).iter().any(|m| crate::episodes::value_at(m, &path).is_some());
        return is_there.then(|| LabelSource::Topic(TopicLabel { topic: marker.clone(), field: path }));
    }
    None
}
