//! The order in which blocks are read.

use super::*;
use crate::log::BlockRef;

const SECOND: u64 = 1_000_000_000;

/// Writes messages of `(channel, seconds)`, each in a chunk of its own, and returns the order in which they are read.
fn read_order(layout: Layout, messages: &[(u16, u64)]) -> (Vec<u64>, Vec<u32>) {
    let options = layout.options().chunk_size(Some(1));
    let mut writer = TestWriter(options.create(Cursor::new(Vec::new())).unwrap());
    for topic in ["/a", "/b"] {
        writer.channel(0, topic);
    }
    for &(channel, seconds) in messages {
        writer.message(channel, 0, seconds * SECOND, &[0; 8]);
    }
    let reading = read(&writer.finish());
    assert_eq!(reading.damage, []);
    // The writer puts the channels' definitions into a first chunk without messages.
    let with_messages = reading.log.blocks().iter().filter(|block| block.start_ns.is_some());
    let segments = with_messages.map(|block: &BlockRef| block.clock_segment).collect();
    (reading.messages.iter().map(|message| message.log_time / SECOND).collect(), segments)
}

fn check_order(messages: &[(u16, u64)], expected: &[u64], segments: &[u32]) {
    let without_indexes = Layout { has_message_indexes: false, ..LAYOUTS[0] };
    for layout in [LAYOUTS[0], LAYOUTS[2], LAYOUTS[4], without_indexes] {
        let (order, found) = read_order(layout, messages);
        assert_eq!(order, expected, "{}", layout.name);
        assert_eq!(found, segments, "{}", layout.name);
    }
}

#[test]
fn growing_times_are_read_as_they_lie() {
    check_order(&[(1, 1), (2, 1), (1, 2), (2, 3)], &[1, 1, 2, 3], &[0; 4]);
}

#[test]
fn topics_one_after_the_other_are_sorted() {
    check_order(&[(1, 10), (1, 20), (1, 30), (2, 11), (2, 19), (2, 31)], &[10, 11, 19, 20, 30, 31], &[0; 6]);
}

#[test]
fn a_clock_reset_keeps_the_order_of_the_file() {
    check_order(
        &[(1, 10), (2, 11), (1, 20), (1, 1), (2, 2), (1, 5)],
        &[10, 11, 20, 1, 2, 5],
        &[0, 0, 0, 1, 1, 1],
    );
}

#[test]
fn disorder_within_the_window_is_sorted_by_start() {
    let layout = LAYOUTS[0];
    let options = layout.options().chunk_size(Some(1));
    let mut writer = TestWriter(options.create(Cursor::new(Vec::new())).unwrap());
    writer.channel(0, "/a");
    for time in [10.0, 10.5, 10.2, 11.0] {
        writer.message(1, 0, (time * 1e9) as u64, &[0; 8]);
    }
    let times: Vec<u64> =
        read(&writer.finish()).messages.iter().map(|message| message.log_time / 100_000_000).collect();
    assert_eq!(times, [100, 102, 105, 110]);
}

#[test]
fn log_time_zero_does_not_move_a_chunk_to_the_front() {
    let year = 40 * 365 * 24 * 3600;
    let options = LAYOUTS[0].options().chunk_size(Some(60));
    let mut writer = TestWriter(options.create(Cursor::new(Vec::new())).unwrap());
    writer.channel(0, "/a");
    writer.channel(0, "/latched");
    for i in 0..6 {
        writer.message(1, 0, (year + i) * SECOND, &[0; 8]);
        if i == 3 {
            writer.message(2, 0, 0, &[0; 8]);
        }
    }
    let reading = read(&writer.finish());
    let times: Vec<u64> =
        reading.messages.iter().map(|message| (message.log_time / SECOND).saturating_sub(year)).collect();
    assert_eq!(times, [0, 1, 2, 3, 0, 4, 5]);
    assert!(reading.log.blocks().len() > 2);
}

#[test]
fn a_loose_log_keeps_its_clock_resets() {
    // Blocks of loose messages are 4 MiB: two of them with the clock reset between.
    let mut writer = LAYOUTS[3].writer();
    writer.channel(0, "/a");
    for i in 0..6 {
        writer.message(1, 0, (100 + i) * SECOND, &vec![7; 2 << 20]);
    }
    for i in 0..6 {
        writer.message(1, 0, (1 + i) * SECOND, &vec![7; 2 << 20]);
    }
    let reading = read(&writer.finish());
    let times: Vec<u64> = reading.messages.iter().map(|message| message.log_time / SECOND).collect();
    assert_eq!(times, [100, 101, 102, 103, 104, 105, 1, 2, 3, 4, 5, 6]);
    assert!(reading.log.blocks().len() > 3);
}

#[test]
fn a_chunk_across_the_end_of_a_topic_is_read_in_parts() {
    // Chunks of about eight messages: one holds the end of /a and the start of /b.
    for layout in [LAYOUTS[0], LAYOUTS[3], LAYOUTS[4]] {
        let options = layout.options().chunk_size(Some(330));
        let mut writer = TestWriter(options.create(Cursor::new(Vec::new())).unwrap());
        writer.channel(0, "/a");
        writer.channel(0, "/b");
        for (channel, shift) in [(1, 0), (2, 1)] {
            for i in 0..60 {
                writer.message(channel, i, (100 + u64::from(i)) * SECOND + shift, &[0; 8]);
            }
        }
        let bytes = writer.finish();
        let reading = read(&bytes);
        assert_eq!((reading.messages.len(), &reading.damage), (120, &vec![]), "{}", layout.name);
        let topic_times = |topic: &str| -> Vec<u64> {
            reading
                .messages
                .iter()
                .filter(|message| message.topic == topic)
                .map(|message| message.log_time)
                .collect()
        };
        for topic in ["/a", "/b"] {
            assert!(topic_times(topic).is_sorted(), "{}: {topic} runs back", layout.name);
        }
        if layout.is_chunked {
            let times: Vec<u64> = reading.messages.iter().map(|message| message.log_time / SECOND).collect();
            let latest =
                times.iter().scan(0, |latest, &time| Some(std::mem::replace(latest, time.max(*latest))));
            let worst = latest.zip(&times).map(|(latest, &time)| latest.saturating_sub(time)).max();
            assert!(worst < Some(16), "{}: runs back by {worst:?} s", layout.name);
        }
        assert_eq!(
            reading
                .log
                .blocks_in_file_order()
                .iter()
                .map(|block| reading.log.read_block(block).messages.len())
                .sum::<usize>(),
            120
        );
    }
}
