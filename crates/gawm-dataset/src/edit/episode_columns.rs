//! The episode table of a LeRobot v3.0 folder: numbers, places of videos, statistics, and columns of others as they were.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, Float64Array, Int64Array, ListBuilder, RecordBatch, StringArray, StringBuilder,
};
use arrow::datatypes::{Field, Schema as ArrowSchema};
use serde_json::{Map, Value, json};

use super::lerobot_output::OutEpisode;
use super::{EditError, Input};
use crate::block::int_array;
use crate::episode::FeatureStats;
use crate::layout::{EPISODES, file_position};
use crate::read::{DType, episode_statistics};
use crate::tables::{stats_columns, to_parquet};

/// Returns the episode table; without statistics when `stats` is empty.
pub(super) fn episode_table(
    inputs: &[Input],
    episodes: &[OutEpisode<'_>],
    stats: &[BTreeMap<String, FeatureStats>],
) -> Result<Vec<u8>, EditError> {
    let mut columns: Vec<(String, ArrayRef)> = Vec::new();
    let ints = |value: &dyn Fn(&OutEpisode<'_>) -> u64| int_array(episodes.iter().map(|e| value(e) as i64));
    columns.push(("episode_index".to_owned(), int_array(0..episodes.len() as i64)));
    columns.push(("tasks".to_owned(), text_lists(episodes.iter().map(|e| e.tasks.as_slice()))));
    columns.push(("length".to_owned(), ints(&|e| e.length)));
    columns.push(("data/chunk_index".to_owned(), ints(&|e| file_position(e.file).0)));
    columns.push(("data/file_index".to_owned(), ints(&|e| file_position(e.file).1)));
    columns.push(("dataset_from_index".to_owned(), ints(&|e| e.from_index)));
    columns.push(("dataset_to_index".to_owned(), ints(&|e| e.from_index + e.length)));
    let cameras: BTreeSet<&String> = episodes.iter().flat_map(|e| e.videos.keys()).collect();
    for camera in &cameras {
        let place = |e: &OutEpisode<'_>| e.videos.get(*camera).copied();
        let number = |e: &OutEpisode<'_>| place(e).map_or(0, |p| p.number);
        let secs = |value: &dyn Fn(&OutEpisode<'_>) -> f64| -> ArrayRef {
            Arc::new(Float64Array::from_iter_values(episodes.iter().map(value)))
        };
        columns.push((format!("videos/{camera}/chunk_index"), ints(&|e| file_position(number(e)).0)));
        columns.push((format!("videos/{camera}/file_index"), ints(&|e| file_position(number(e)).1)));
        let from = secs(&|e| place(e).map_or(0.0, |p| p.from_secs));
        columns.push((format!("videos/{camera}/from_timestamp"), from));
        columns
            .push((format!("videos/{camera}/to_timestamp"), secs(&|e| place(e).map_or(0.0, |p| p.to_secs))));
    }
    columns.push(("meta/episodes/chunk_index".to_owned(), ints(&|_| 0)));
    columns.push(("meta/episodes/file_index".to_owned(), ints(&|_| 0)));
    let taken: BTreeSet<String> = columns.iter().map(|(name, _)| name.clone()).collect();
    columns.extend(extra_columns(episodes).into_iter().filter(|(name, _)| !taken.contains(name)));
    let features: BTreeSet<&String> = stats.iter().flat_map(BTreeMap::keys).collect();
    for feature in features {
        let is_camera = inputs[0].dataset.info.feature(feature).is_some_and(|f| f.is_camera());
        // A feature that an episode knows nothing of has no statistics at all: LeRobot stumbles over empty ones.
        let of: Option<Vec<&FeatureStats>> = stats.iter().map(|episode| episode.get(feature)).collect();
        if let Some(of) = of {
            columns.extend(stats_columns(feature, &of, is_camera));
        }
    }
    let fields: Vec<Field> = columns
        .iter()
        .map(|(name, array)| Field::new(name, array.data_type().clone(), array.null_count() > 0))
        .collect();
    let arrays = columns.into_iter().map(|(_, array)| array).collect();
    Ok(to_parquet(Path::new(EPISODES), RecordBatch::try_new(Arc::new(ArrowSchema::new(fields)), arrays))?)
}

fn text_lists<'a>(lists: impl Iterator<Item = &'a [String]>) -> ArrayRef {
    let mut builder = ListBuilder::new(StringBuilder::new());
    for list in lists {
        list.iter().for_each(|text| builder.values().append_value(text));
        builder.append(true);
    }
    Arc::new(builder.finish())
}

/// Returns the columns that only others know (success, session, ...), with the type that all their values have.
fn extra_columns(episodes: &[OutEpisode<'_>]) -> Vec<(String, ArrayRef)> {
    let names: BTreeSet<&String> = episodes.iter().flat_map(|episode| episode.extras.keys()).collect();
    let column = |name: &String| {
        let values: Vec<&Value> =
            episodes.iter().map(|episode| episode.extras.get(name).unwrap_or(&Value::Null)).collect();
        (name.clone(), array_of(&values))
    };
    names.into_iter().map(column).collect()
}

/// Returns values as the narrowest column that holds them all; objects and mixtures as JSON text.
fn array_of(values: &[&Value]) -> ArrayRef {
    let known: Vec<&&Value> = values.iter().filter(|v| !v.is_null()).collect();
    if !known.is_empty() && known.iter().all(|v| v.is_boolean()) {
        return Arc::new(values.iter().map(|v| v.as_bool()).collect::<BooleanArray>());
    }
    if !known.is_empty() && known.iter().all(|v| v.is_i64()) {
        return Arc::new(values.iter().map(|v| v.as_i64()).collect::<Int64Array>());
    }
    if !known.is_empty() && known.iter().all(|v| v.is_number()) {
        return Arc::new(values.iter().map(|v| v.as_f64()).collect::<Float64Array>());
    }
    let is_texts = |v: &&Value| v.as_array().is_some_and(|list| list.iter().all(Value::is_string));
    if known.len() == values.len() && !known.is_empty() && known.iter().all(|v| is_texts(v)) {
        let lists: Vec<Vec<String>> = known
            .iter()
            .map(|v| {
                v.as_array().into_iter().flatten().filter_map(Value::as_str).map(str::to_owned).collect()
            })
            .collect();
        return text_lists(lists.iter().map(Vec::as_slice));
    }
    let text = |v: &&Value| match v {
        Value::Null => None,
        Value::String(text) => Some(text.clone()),
        other => Some(other.to_string()),
    };
    Arc::new(values.iter().map(text).collect::<StringArray>())
}

/// Takes the statistics of cameras in video files over from the inputs: pixels are not decoded.
///
/// Returns those of the whole output: moments are merged, quantiles are means weighted by count, as LeRobot has them.
pub(super) fn video_statistics(
    inputs: &[Input],
    episodes: &[OutEpisode<'_>],
    per_episode: &mut [BTreeMap<String, FeatureStats>],
) -> Map<String, Value> {
    let mut totals = Map::new();
    let videos: Vec<String> = inputs[0]
        .dataset
        .info
        .features
        .iter()
        .filter(|f| f.dtype == DType::Video)
        .map(|f| f.name.clone())
        .collect();
    let kept: Vec<String> = inputs[0].videos();
    if kept.is_empty() {
        return totals;
    }
    let known: Vec<_> = inputs.iter().map(|input| episode_statistics(&input.dataset, &videos)).collect();
    for camera in kept {
        let mut found: Vec<FeatureStats> = Vec::new();
        for (episode, stats) in episodes.iter().zip(per_episode.iter_mut()) {
            let input = &inputs[episode.piece.input];
            let index = input.dataset.runs[episode.piece.run].episode_index;
            let own = known[episode.piece.input].get(&(index, camera.clone()));
            let whole = || {
                let value = input.dataset.stats.as_ref()?.get(&camera)?;
                let mut stats = FeatureStats::from_json(value)?;
                stats.count = stats.count.min(episode.length).max(1);
                Some(stats)
            };
            if let Some(one) = own.cloned().or_else(whole) {
                stats.insert(camera.clone(), one.clone());
                found.push(one);
            }
        }
        if let Some(total) = merged(&found) {
            let list = |values: &[f64]| values.iter().map(|v| json!([[v]])).collect::<Vec<_>>();
            let mut object: Map<String, Value> = total
                .named()
                .iter()
                .map(|(name, values)| ((*name).to_owned(), json!(list(values))))
                .collect();
            object.insert("count".to_owned(), json!([total.count]));
            totals.insert(camera, Value::Object(object));
        }
    }
    totals
}

fn merged(parts: &[FeatureStats]) -> Option<FeatureStats> {
    let first = parts.first()?;
    let width = first.mean.len();
    let is_sound = |part: &&FeatureStats| part.named().iter().all(|(_, values)| values.len() == width);
    let parts: Vec<&FeatureStats> = parts.iter().filter(is_sound).collect();
    let n: f64 = parts.iter().map(|part| part.count as f64).sum();
    let weighted = |value: &dyn Fn(&FeatureStats) -> f64| {
        parts.iter().map(|part| part.count as f64 * value(part)).sum::<f64>() / n.max(1.0)
    };
    let mut total = FeatureStats { count: n as u64, ..FeatureStats::default() };
    for i in 0..width {
        let mean = weighted(&|part| part.mean[i]);
        let variance = weighted(&|part| part.std[i].powi(2) + (part.mean[i] - mean).powi(2));
        total.mean.push(mean);
        total.std.push(variance.sqrt());
        total.min.push(parts.iter().map(|part| part.min[i]).fold(f64::INFINITY, f64::min));
        total.max.push(parts.iter().map(|part| part.max[i]).fold(f64::NEG_INFINITY, f64::max));
        total.q01.push(weighted(&|part| part.q01[i]));
        total.q10.push(weighted(&|part| part.q10[i]));
        total.q50.push(weighted(&|part| part.q50[i]));
        total.q90.push(weighted(&|part| part.q90[i]));
        total.q99.push(weighted(&|part| part.q99[i]));
    }
    (!parts.is_empty()).then_some(total)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_type(values: &[Value], expected: &str) {
        let array = array_of(&values.iter().collect::<Vec<_>>());
        assert_eq!(array.data_type().to_string(), expected, "{values:?}");
        assert_eq!(array.len(), values.len());
    }

    #[test]
    fn foreign_columns_keep_their_type() {
        check_type(&[json!(true), json!(null)], "Boolean");
        check_type(&[json!(3), json!(-4)], "Int64");
        check_type(&[json!(3), json!(0.5)], "Float64");
        check_type(&[json!("a"), json!(null)], "Utf8");
        check_type(&[json!({"a": 1}), json!("x")], "Utf8");
        check_type(&[json!(null)], "Utf8");
        assert!(array_of(&[&json!(["a", "b"])]).data_type().to_string().starts_with("List"));
    }

    #[test]
    fn moments_of_parts_give_those_of_the_whole() {
        let part = |count, mean: f64, std: f64| FeatureStats {
            min: vec![0.0],
            max: vec![1.0],
            mean: vec![mean],
            std: vec![std],
            q01: vec![0.0],
            q10: vec![0.0],
            q50: vec![mean],
            q90: vec![1.0],
            q99: vec![1.0],
            count,
        };
        // 1, 3 and 5, 5: mean 3.5, variance (6.25 + 0.25 + 2.25 + 2.25) / 4.
        let total = merged(&[part(2, 2.0, 1.0), part(2, 5.0, 0.0)]).unwrap();
        assert_eq!((total.count, total.mean[0]), (4, 3.5));
        assert!((total.std[0] - 2.75f64.sqrt()).abs() < 1e-12);
    }
}
