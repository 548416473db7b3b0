//! One recording on its way through the aligner: order, duplicates, clock resets, marks, counts.

mod marks;
mod video;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use gawm_schema::{FloatType, Kind, Role, rotation};

use super::bind::Binding;
use super::block::{DecodedBlock, DecodedMessage};
use super::picture::Picture;
use super::plan::{Plans, Row};
use super::report::Counts;
use super::sink::{EpisodeSink, IntervalInfo};
use crate::align::{AlignRule, Aligner, SampleTime, Stop};
use crate::contract::{CheckedContract, Clock, EpisodeRule, GapRule, MarkerValue, NonFiniteRule, StreamData};
use crate::decode::CameraInfo;
use crate::episodes::{Mark, Marks};
use crate::log::Damage;

/// This many messages in a row of one topic, all before the disorder window, mean that its clock was reset.
const RESET_MESSAGES: usize = 3;

/// Image bytes that may wait for the disorder window to pass.
const MAX_IMAGE_BYTES: usize = 192 << 20;

/// A stream that begins this much later than the first is worth a warning.
const LATE_STREAM_NS: i64 = 1_000_000_000;

/// Everything that is fixed for a recording.
pub(crate) struct SessionRules<'a> {
    pub(crate) contract: &'a CheckedContract,
    pub(crate) binding: &'a Binding,
    pub(crate) plans: &'a Plans,
    pub(crate) rule: &'a AlignRule,
    /// Expected size of the pictures of each stream, before crop and resize; learned from the first.
    pub(crate) label_fields: Vec<(String, String)>,
    /// Whether records give the times of episodes, so that the time between them says nothing.
    pub(crate) is_listed: bool,
}

/// The state of a recording.
pub(crate) struct Session<'a, 's> {
    rules: &'a SessionRules<'a>,
    aligner: Aligner<Picture>,
    pub(crate) sink: EpisodeSink<'s>,
    pub(crate) counts: Counts,
    pub(crate) warnings: Vec<String>,
    pub(crate) damage: Vec<Damage>,
    pub(crate) camera_infos: BTreeMap<String, CameraInfo>,
    /// By topic what is known of its video.
    videos: BTreeMap<usize, video::VideoTopic>,
    marks: BTreeMap<(i64, u64), Mark>,
    is_marked: bool,
    mark_counts: marks::MarkCounts,
    recent: Vec<Recent>,
    sizes: BTreeMap<usize, (u32, u32)>,
    ordinal: u64,
    newest_log_ns: Option<i64>,
    segments: u64,
    reordered: u64,
    not_in_message: BTreeMap<String, u64>,
    unclosed: u64,
    /// The disorder window where images had to leave memory earlier.
    shortest_window_ns: i64,
    /// Samples that cannot be used, by stream and what is wrong with them.
    non_finite: BTreeMap<(usize, &'static str), u64>,
    /// Values of a sample on their way to the aligner.
    scratch: Vec<f64>,
    /// Usable samples per stream over all segments.
    pub(crate) samples: Vec<u64>,
    /// The earliest sample of each stream, as rows count time.
    first_ns: Vec<Option<i64>>,
}

/// What is remembered of a topic.
#[derive(Debug, Default, Clone)]
struct Recent {
    /// Messages within the disorder window, in order.
    seen: VecDeque<MessageKey>,
}

/// Log time, sequence, publish time, CRC and length: two messages of a topic that share all are one written twice.
type MessageKey = (i64, u32, i64, u32, usize);

/// What a message is to those of its topic before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Arrival {
    InOrder,
    OutOfOrder,
    Duplicate,
}

impl Recent {
    fn take(&mut self, key: MessageKey, window_ns: i64) -> Arrival {
        let arrival = match self.seen.back() {
            Some(newest) if *newest >= key => match self.seen.binary_search(&key) {
                Ok(_) => return Arrival::Duplicate,
                Err(at) => {
                    let is_late = key.0 < newest.0;
                    self.seen.insert(at, key);
                    if is_late { Arrival::OutOfOrder } else { Arrival::InOrder }
                }
            },
            _ => {
                self.seen.push_back(key);
                Arrival::InOrder
            }
        };
        let low = self.seen.back().map_or(i64::MIN, |newest| newest.0.saturating_sub(window_ns));
        while self.seen.front().is_some_and(|oldest| oldest.0 < low) {
            self.seen.pop_front();
        }
        arrival
    }
}

impl<'a, 's> Session<'a, 's> {
    pub(crate) fn new(rules: &'a SessionRules<'a>, sink: EpisodeSink<'s>) -> Self {
        let mut counts = Counts::default();
        for topic in &rules.plans.topics {
            counts.add_mapped(&topic.topic);
        }
        let mut session = Self {
            rules,
            aligner: Aligner::new(rules.rule.clone()),
            sink,
            counts,
            warnings: Vec::new(),
            damage: Vec::new(),
            camera_infos: BTreeMap::new(),
            videos: BTreeMap::new(),
            marks: BTreeMap::new(),
            is_marked: false,
            mark_counts: marks::MarkCounts::default(),
            recent: vec![Recent::default(); rules.plans.topics.len()],
            sizes: BTreeMap::new(),
            ordinal: 0,
            newest_log_ns: None,
            segments: 0,
            reordered: 0,
            not_in_message: BTreeMap::new(),
            unclosed: 0,
            shortest_window_ns: i64::MAX,
            non_finite: BTreeMap::new(),
            scratch: Vec::new(),
            samples: vec![0; rules.rule.streams.len()],
            first_ns: vec![None; rules.rule.streams.len()],
        };
        session.open_segment();
        session
    }

    pub(crate) fn plans(&self) -> &'a Plans {
        self.rules.plans
    }

    pub(crate) fn newest_log_ns(&self) -> Option<i64> {
        self.newest_log_ns
    }

    fn open_segment(&mut self) {
        match &self.rules.contract.episodes {
            EpisodeRule::File | EpisodeRule::Gap { .. } => {
                let id = self.aligner.open_interval(i64::MIN);
                self.sink.intervals.insert(id + self.sink.interval_base, IntervalInfo::default());
            }
            EpisodeRule::Metadata { record, start_key, end_key, scale_ns } => {
                let records: Vec<_> =
                    self.sink.recording.metadata.iter().filter(|(name, _)| name == record).cloned().collect();
                if records.is_empty() {
                    let names: BTreeSet<&String> =
                        self.sink.recording.metadata.iter().map(|(name, _)| name).collect();
                    self.warn(format!(
                        "episodes.record: there is no metadata record {record:?}, there are {names:?}"
                    ));
                }
                let mut spans = Vec::new();
                for found in records {
                    let time = |key: &str| found.1.get(key).and_then(|text| parse_time(text, *scale_ns));
                    match (time(start_key), time(end_key)) {
                        (Some(start), Some(end)) if start <= end => spans.push((start, end, found)),
                        _ => self.warn(format!(
                            "metadata record {record:?}: expected a time in {start_key:?} and a later one in {end_key:?}, got {:?}; this episode is left out",
                            found.1
                        )),
                    }
                }
                spans.sort_by_key(|(start, end, _)| (*start, *end));
                for (start, end, found) in spans {
                    let id = self.aligner.open_interval(start);
                    self.aligner.close_interval(end);
                    let info = IntervalInfo { record: Some(found), end_ns: Some(end) };
                    self.sink.intervals.insert(id + self.sink.interval_base, info);
                }
            }
            EpisodeRule::Marker { .. } => self.is_marked = false,
        }
    }

    fn warn(&mut self, text: String) {
        if !self.warnings.contains(&text) {
            self.warnings.push(text);
        }
    }

    /// Takes the next block. `complete_log_ns`: no later block holds an earlier log time; none when that is not known.
    pub(crate) fn take(
        &mut self,
        block: DecodedBlock,
        is_new_segment: bool,
        complete_log_ns: Option<i64>,
    ) -> Result<(), Stop> {
        self.damage.extend(block.damage);
        for (topic, count) in &block.unmapped {
            self.counts.read(topic, *count);
        }
        if is_new_segment {
            self.reset_clock("the file's chunks")?;
        }
        let resets = resets_of(&block.messages, self.rules.contract.disorder_window_ns, self.recent.len());
        for (index, message) in block.messages.into_iter().enumerate() {
            if let Some(topic) = resets.get(&index) {
                let name = self.rules.plans.topics[*topic].topic.clone();
                self.reset_clock(&name)?;
            }
            self.take_message(message, &block.rows, &block.values);
        }
        let window = self.rules.contract.disorder_window_ns;
        let complete = complete_log_ns.or(self.newest_log_ns);
        if let Some(complete) = complete {
            self.advance(complete.saturating_sub(window))?;
            self.limit_images(complete, window)?;
        }
        Ok(())
    }

    /// Makes rows before the disorder window is over, if its images take too much memory.
    fn limit_images(&mut self, complete_ns: i64, window_ns: i64) -> Result<(), Stop> {
        for eighth in 1..=8 {
            let held_bytes: usize = self.aligner.images().map(Picture::held_bytes).sum();
            if held_bytes <= MAX_IMAGE_BYTES {
                break;
            }
            let left_ns = window_ns - window_ns / 8 * eighth;
            self.shortest_window_ns = self.shortest_window_ns.min(left_ns);
            self.advance(complete_ns.saturating_sub(left_ns))?;
        }
        Ok(())
    }

    /// Makes the rows that remain.
    pub(crate) fn finish(&mut self) -> Result<(), Stop> {
        self.close_segment()?;
        if self.reordered > 0 {
            let text = format!(
                "{} messages of mapped topics were out of order and have been sorted",
                self.reordered
            );
            self.warn(text);
        }
        for (topic, count) in std::mem::take(&mut self.not_in_message) {
            self.warn(format!(
                "{topic}: {count} messages hold none of the mapped elements, and were passed over"
            ));
        }
        if self.shortest_window_ns < i64::MAX {
            let text = format!(
                "the images of disorder_window_ms take over {} MB, so the window was cut to {:.0} ms where needed: messages that come later than that are lost as beyond_disorder_window",
                MAX_IMAGE_BYTES >> 20,
                self.shortest_window_ns as f64 / 1e6
            );
            self.warn(text);
        }
        self.warn_of_late_streams();
        if let EpisodeRule::Marker { topic, field, start, stop, .. } = &self.rules.contract.episodes {
            let marks = Marks { field: field.clone(), start: start.clone(), stop: stop.clone() };
            self.mark_counts.complaint(topic, &marks).into_iter().for_each(|text| self.warn(text));
        }
        if self.unclosed > 0 {
            let text = format!(
                "{} episodes have no end mark; closed at the next start or at the end of the log",
                self.unclosed
            );
            self.warn(text);
        }
        for ((stream, defect), count) in std::mem::take(&mut self.non_finite) {
            let name = &self.rules.binding.streams[stream].name;
            let text = format!("stream {name:?}: {count} samples hold {defect}; their rows are not valid");
            self.warn(text);
        }
        Ok(())
    }

    /// Says which streams keep rows from beginning when the others do.
    fn warn_of_late_streams(&mut self) {
        let is_whole = matches!(self.rules.contract.episodes, EpisodeRule::File | EpisodeRule::Gap { .. });
        let Some(earliest) = self.first_ns.iter().flatten().min().copied() else { return };
        if !is_whole || self.rules.is_listed || self.segments > 0 {
            return;
        }
        for stream in 0..self.first_ns.len() {
            let late_ns = self.first_ns[stream].map_or(0, |first| first.saturating_sub(earliest));
            if late_ns > LATE_STREAM_NS && self.rules.rule.streams[stream].is_required() {
                let name = &self.rules.binding.streams[stream].name;
                let topic = &self.rules.binding.streams[stream].topic;
                let text = format!(
                    "stream {name:?} ({topic}) begins {:.3} s after the first sample of the log: there is no row before (of numbers, gap = \"mask\" does not wait)",
                    late_ns as f64 / 1e9
                );
                self.warn(text);
            }
        }
    }

    fn close_segment(&mut self) -> Result<(), Stop> {
        self.finish_videos();
        self.apply_marks(i64::MAX);
        if self.is_marked {
            self.unclosed += 1;
        }
        self.aligner.finish(&mut self.sink)?;
        for (stream, samples) in self.samples.iter_mut().enumerate() {
            *samples += self.aligner.samples(stream);
        }
        Ok(())
    }

    fn reset_clock(&mut self, by: &str) -> Result<(), Stop> {
        self.close_segment()?;
        let intervals = self.sink.intervals.keys().next_back().map_or(0, |last| last + 1);
        self.sink.interval_base = intervals.max(self.sink.interval_base);
        self.segments += 1;
        let at = self.newest_log_ns.unwrap_or_default();
        if self.segments <= 10 {
            self.warn(format!("clock reset of {by} after {at} ns: log times run back; a new episode begins"));
        } else if self.segments == 11 {
            self.warn("more clock resets, not listed".to_owned());
        }
        self.aligner = Aligner::new(self.rules.rule.clone());
        self.newest_log_ns = None;
        self.recent.iter_mut().for_each(|recent| *recent = Recent::default());
        self.open_segment();
        Ok(())
    }

    fn advance(&mut self, complete_ns: i64) -> Result<(), Stop> {
        self.apply_marks(complete_ns);
        self.aligner.advance(complete_ns, &mut self.sink)
    }

    /// Opens and closes intervals by the marks before a time.
    fn apply_marks(&mut self, complete_ns: i64) {
        let (has_stop, is_state) = match &self.rules.contract.episodes {
            EpisodeRule::Marker { start, stop, .. } => {
                let is_truth = |value: &MarkerValue| matches!(value, MarkerValue::Bool(_));
                (stop.is_some(), is_truth(start) && stop.as_ref().is_some_and(is_truth))
            }
            _ => (false, false),
        };
        while let Some(entry) = self.marks.first_entry().filter(|entry| entry.key().0 < complete_ns) {
            let ((time_ns, _), mark) = entry.remove_entry();
            let last = self.sink.intervals.keys().next_back().copied();
            match mark {
                // A truth value is a state, which messages may repeat.
                Mark::Start if self.is_marked && is_state => {}
                Mark::Stop if !self.is_marked && is_state => {}
                Mark::Start => {
                    if self.is_marked {
                        self.unclosed += u64::from(has_stop);
                        self.aligner.close_interval(time_ns - 1);
                        self.set_end(last, time_ns - 1);
                    }
                    let id = self.aligner.open_interval(time_ns);
                    self.sink.intervals.insert(id + self.sink.interval_base, IntervalInfo::default());
                    self.is_marked = true;
                }
                Mark::Stop if self.is_marked => {
                    self.aligner.close_interval(time_ns);
                    self.set_end(last, time_ns);
                    self.is_marked = false;
                }
                Mark::Stop => self.warn("an end mark without a start mark was passed over".to_owned()),
            }
        }
    }

    fn set_end(&mut self, interval: Option<u64>, end_ns: i64) {
        if let Some(info) = interval.and_then(|interval| self.sink.intervals.get_mut(&interval)) {
            info.end_ns = Some(end_ns);
        }
    }

    fn take_message(&mut self, mut message: DecodedMessage, rows: &[Row], values: &[f64]) {
        let rules = self.rules;
        let name = rules.plans.topics[message.topic].topic.as_str();
        self.counts.read(name, 1);
        self.ordinal += 1;
        let window = self.rules.contract.disorder_window_ns;
        if let Some(newest) = self.newest_log_ns
            && !self.rules.is_listed
            && message.log_ns.saturating_sub(newest) > self.rules.contract.max_gap_ns
        {
            let gap_s = message.log_ns.saturating_sub(newest) as f64 / 1e9;
            self.warn(format!(
                "log times jump forward by {gap_s:.3} s at {newest} ns ({name}): nothing is resampled across it"
            ));
        }
        self.newest_log_ns = Some(self.newest_log_ns.map_or(message.log_ns, |ns| ns.max(message.log_ns)));
        let key = (message.log_ns, message.sequence, message.publish_ns, message.crc, message.length);
        match self.recent[message.topic].take(key, window) {
            Arrival::Duplicate => {
                return self.counts.lost(name, "duplicate", 1, || format!("offset {}", message.offset));
            }
            Arrival::OutOfOrder => self.reordered += 1,
            Arrival::InOrder => {}
        }
        if let Some(loss) = message.loss() {
            return self
                .counts
                .lost(name, loss.reason, 1, || format!("offset {}: {}", message.offset, loss.detail));
        }
        self.take_rows(&message, message.rows(rows), values, name);
        if let Some(extras) = message.take_extras() {
            if let Some(info) = extras.camera_info {
                self.camera_infos.entry(name.to_owned()).or_insert(info);
            }
            if let Some(event) = extras.event {
                self.take_event(&message, &event, name);
            }
            if let Some((picture, stamp_ns)) = extras.picture {
                match picture.packet() {
                    Some(packet) => self.take_packet(message, packet, stamp_ns),
                    None => self.take_picture(&message, &picture, stamp_ns, name),
                }
            }
        }
    }

    fn times(&self, stream: usize, message: &DecodedMessage, stamp_ns: Option<i64>) -> SampleTime {
        let rule = &self.rules.binding.streams[stream].rule;
        let time_ns = clock_time(&rule.clock, message, stamp_ns);
        let clock_ns = time_ns.saturating_add(rule.offset_ns);
        let key_ns = if self.rules.contract.by_arrival {
            message.log_ns.saturating_add(rule.offset_ns)
        } else {
            clock_ns
        };
        SampleTime { key_ns, clock_ns, log_ns: message.log_ns, ordinal: self.ordinal }
    }

    fn take_rows(&mut self, message: &DecodedMessage, rows: &[Row], values: &[f64], name: &str) {
        let rules = self.rules;
        let topic = &rules.plans.topics[message.topic];
        let mut late = None;
        if rows.is_empty() && topic.has_vectors() {
            *self.not_in_message.entry(name.to_owned()).or_default() += 1;
        }
        for (stream, stamp_ns, row) in topic.samples(rows, values) {
            let rule = &rules.binding.streams[stream].rule;
            let StreamData::Vector(vector) = &rule.data else { continue };
            let mut converted = std::mem::take(&mut self.scratch);
            converted.clear();
            converted.extend(row.iter().map(|&value| vector.unit.apply(value)));
            let is_encoded = matches!(rule.role, Role::State | Role::Action);
            let is_float32 = is_encoded || rules.contract.written.float == FloatType::Float32;
            if let Some(defect) = defect_of(&mut converted, vector.kind, (is_encoded, is_float32)) {
                if rule.non_finite == NonFiniteRule::Reject {
                    self.scratch = converted;
                    self.counts.lost(name, "non_finite", 1, || format!("offset {}", message.offset));
                    return;
                }
                *self.non_finite.entry((stream, defect)).or_default() += 1;
            }
            let time = self.times(stream, message, stamp_ns);
            note_first(&mut self.first_ns[stream], time.key_ns);
            if let Err(error) = self.aligner.push_values(stream, time, &converted) {
                late = Some(error);
            }
            self.scratch = converted;
        }
        if let Some(late) = late {
            self.count_late(name, message, late);
        }
    }

    fn count_late(&mut self, name: &str, message: &DecodedMessage, late: crate::align::Late) {
        let behind_ms = (late.complete_ns - late.key_ns) as f64 / 1e6;
        self.counts.lost(name, "beyond_disorder_window", 1, || {
            format!("offset {}: its time {} ns is {behind_ms:.1} ms before what was complete; raise disorder_window_ms, or choose another clock", message.offset, late.key_ns)
        });
    }

    fn take_picture(
        &mut self,
        message: &DecodedMessage,
        picture: &Picture,
        stamp_ns: Option<i64>,
        name: &str,
    ) {
        let rules = self.rules;
        for &stream in &rules.plans.topics[message.topic].images {
            let size = picture.recorded_size();
            let expected = *self.sizes.entry(stream).or_insert(size);
            if size != expected {
                self.counts.lost(name, "image_size_changed", 1, || {
                    format!(
                        "offset {}: expected {}x{}, got {}x{}",
                        message.offset, expected.0, expected.1, size.0, size.1
                    )
                });
                return;
            }
            let time = self.times(stream, message, stamp_ns);
            note_first(&mut self.first_ns[stream], time.key_ns);
            if let Err(late) = self.aligner.push_image(stream, time, picture.clone()) {
                self.count_late(name, message, late);
                return;
            }
        }
    }

    fn take_event(&mut self, message: &DecodedMessage, event: &serde_json::Value, name: &str) {
        if let EpisodeRule::Marker { topic, field, start, stop, clock } = &self.rules.contract.episodes
            && topic == name
        {
            let marks = Marks { field: field.clone(), start: start.clone(), stop: stop.clone() };
            if let Some(mark) = self.mark_counts.take(&marks, event) {
                let time_ns = marks::time_of(clock, event, message.publish_ns, message.log_ns);
                self.marks.insert((time_ns, self.ordinal), mark);
            }
        }
        self.sink.recording.take(name, &self.rules.label_fields, message.log_ns, event);
    }
}

/// Returns what keeps a sample from being used, if anything; it is then no number any more.
///
/// States and actions are encoded as 32-bit floats, and their rotations need a direction; truth values are 0 or 1.
pub(crate) fn defect_of(
    values: &mut [f64],
    kind: Kind,
    (is_encoded, is_float32): (bool, bool),
) -> Option<&'static str> {
    let defect = if values.iter().any(|value| !value.is_finite()) {
        "NaN or infinity"
    } else if is_float32 && values.iter().any(|value| !(*value as f32).is_finite()) {
        "numbers beyond 32-bit floats"
    } else if is_encoded && values.chunks_exact(kind.raw_width()).any(|element| !has_rotation(kind, element))
    {
        "quaternions or matrices that are no rotation"
    } else if kind == Kind::Bool && values.iter().any(|value| ![0.0, 1.0].contains(value)) {
        "truth values other than 0 and 1"
    } else {
        return None;
    };
    if is_float32 || kind == Kind::Bool {
        values.fill(f64::NAN);
    }
    Some(defect)
}

fn note_first(first: &mut Option<i64>, ns: i64) {
    *first = Some(first.map_or(ns, |earlier| earlier.min(ns)));
}

fn has_rotation(kind: Kind, element: &[f64]) -> bool {
    match kind {
        Kind::Quaternion { .. } => {
            element.iter().map(|value| value * value).sum::<f64>().sqrt() >= rotation::MIN_NORM
        }
        Kind::Matrix => {
            let matrix: rotation::Matrix = std::array::from_fn(|at| element[at]);
            rotation::determinant(&matrix) >= rotation::MIN_NORM
                && rotation::matrix_from_six(rotation::six_from_matrix(&matrix)).is_some()
        }
        _ => true,
    }
}

fn clock_time(clock: &Clock, message: &DecodedMessage, stamp_ns: Option<i64>) -> i64 {
    match clock {
        Clock::Log => message.log_ns,
        Clock::Publish => message.publish_ns,
        Clock::Stamp | Clock::Field(_) => stamp_ns.unwrap_or(message.publish_ns),
    }
}

fn parse_time(text: &str, scale_ns: f64) -> Option<i64> {
    let text = text.trim();
    if scale_ns == 1.0
        && let Ok(ns) = text.parse::<i64>()
    {
        return Some(ns);
    }
    let value = text.parse::<f64>().ok()? * scale_ns;
    (value.abs() < 9e18).then_some(value.round() as i64)
}

/// Returns where clocks are reset within a block: index of the first message after, and the topic that tells.
///
/// A topic tells of a reset when its times run back by more than the window for [`RESET_MESSAGES`] messages on end, or
/// up to the end of the block; a single message that runs back is a late one.
fn resets_of(messages: &[DecodedMessage], window_ns: i64, n_topics: usize) -> BTreeMap<usize, usize> {
    let mut resets = BTreeMap::new();
    let mut newest: Vec<Option<i64>> = vec![None; n_topics];
    let mut last_good = vec![0; n_topics];
    let mut back: Vec<Vec<usize>> = vec![Vec::new(); n_topics];
    let mut index = 0;
    while index < messages.len() {
        let message = &messages[index];
        let topic = message.topic;
        if newest[topic].is_some_and(|ns| message.log_ns.saturating_add(window_ns) < ns) {
            back[topic].push(index);
        } else {
            back[topic].clear();
            newest[topic] = Some(newest[topic].map_or(message.log_ns, |ns| ns.max(message.log_ns)));
            last_good[topic] = index;
        }
        let n_back = back[topic].len();
        if n_back >= RESET_MESSAGES || (index + 1 == messages.len() && n_back > 0) {
            // Other topics go on from their own first message back, if it comes after this topic's last good one.
            let after = last_good[topic];
            let firsts = back.iter().filter_map(|back| back.iter().find(|&&first| first > after));
            let first = firsts.min().copied().unwrap_or(index);
            resets.insert(first, topic);
            newest.iter_mut().for_each(|newest| *newest = None);
            back.iter_mut().for_each(Vec::clear);
            // What lies between is looked at again, as part of the new segment.
            index = first;
            newest[messages[first].topic] = Some(messages[first].log_ns);
            last_good[messages[first].topic] = first;
        }
        index += 1;
    }
    resets
}

impl Session<'_, '_> {
    /// Returns the streams that had no usable sample: those that rows wait for, and those that they do not.
    pub(crate) fn empty_streams(&self) -> (Vec<usize>, Vec<usize>) {
        let is_required = |stream: &usize| self.rules.binding.streams[*stream].rule.gap != GapRule::Mask;
        (0..self.samples.len()).filter(|&stream| self.samples[stream] == 0).partition(is_required)
    }
}
