//! Logs cut at every kind of place, and logs with changed bytes.

use super::*;

/// Offsets at which a log of `n` bytes is cut: at most `limit`, evenly.
fn cuts(n: usize, limit: usize) -> impl Iterator<Item = usize> {
    (0..n).step_by(n.div_ceil(limit).max(1)).chain([n])
}

fn n_readable(bytes: &[u8]) -> usize {
    open(bytes).map_or(0, |log| read_all(log).messages.len())
}

#[test]
fn the_count_never_falls_as_a_cut_grows() {
    for layout in LAYOUTS {
        let bytes = layout.write();
        let mut most = 0;
        for cut in cuts(bytes.len(), 130) {
            let count = n_readable(&bytes[..cut]);
            assert!(
                count >= most,
                "{}: cut at {cut} gives {count} messages, a smaller cut {most}",
                layout.name
            );
            most = count;
        }
        assert_eq!(most, 60, "{}", layout.name);
    }
}

#[test]
fn every_cut_of_a_loose_log_keeps_each_whole_message() {
    let bytes = LAYOUTS[7].write();
    let records = records_of(&bytes);
    for cut in cuts(bytes.len(), 200) {
        let n_whole = records.iter().filter(|(op, at, length)| *op == 0x05 && at + 9 + length <= cut).count();
        assert_eq!(n_readable(&bytes[..cut]), n_whole, "cut at {cut}");
    }
}

#[test]
fn every_cut_of_an_uncompressed_log_keeps_each_whole_message() {
    let bytes = LAYOUTS[6].write();
    let inner_of = |&(_, at, length): &(u8, usize, usize)| {
        let data = at + 9 + 40;
        super::super::wire::Records::new(&bytes[data..at + 9 + length])
            .map(move |inner| (inner.op, data + inner.at + 9 + inner.body.len()))
    };
    let ends: Vec<usize> = records_of(&bytes)
        .iter()
        .filter(|record| record.0 == 0x06)
        .flat_map(inner_of)
        .filter(|(op, _)| *op == 0x05)
        .map(|(_, end)| end)
        .collect();
    assert_eq!(ends.len(), 60);
    for cut in cuts(bytes.len(), 200) {
        let n_whole = ends.iter().filter(|&&end| end <= cut).count();
        assert_eq!(n_readable(&bytes[..cut]), n_whole, "cut at {cut}");
    }
}

#[test]
fn a_cut_is_reported_wherever_it_is() {
    for layout in LAYOUTS {
        let bytes = layout.write();
        for cut in cuts(bytes.len() - 1, 60).filter(|&cut| cut > 8) {
            let reading = read(&bytes[..cut]);
            assert!(!reading.damage.is_empty(), "{}: cut at {cut} is not reported", layout.name);
        }
    }
}

/// A generator with a fixed seed.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % n
    }
}

#[test]
fn flipped_bits_are_survived() {
    let mut random = Random(1);
    for layout in LAYOUTS {
        let bytes = layout.write();
        for _ in 0..150 {
            let mut damaged = bytes.clone();
            for _ in 0..=random.below(4) {
                let at = random.below(damaged.len());
                damaged[at] ^= 1 << random.below(8);
            }
            // More messages than were written would be made up.
            assert!(n_readable(&damaged) <= 60, "{}", layout.name);
        }
    }
}

#[test]
fn overwritten_and_moved_bytes_are_survived() {
    let mut random = Random(2);
    for layout in LAYOUTS {
        let bytes = layout.write();
        for _ in 0..100 {
            let mut damaged = bytes.clone();
            let (from, length) = (random.below(bytes.len()), random.below(64));
            let to = (from + length).min(damaged.len());
            match random.below(4) {
                0 => damaged[from..to].fill(0),
                1 => damaged[from..to].fill(0xff),
                2 => drop(damaged.drain(from..to)),
                _ => drop(damaged.splice(from..from, bytes[from..to].to_vec())),
            }
            n_readable(&damaged);
        }
    }
}

#[test]
fn one_flipped_bit_in_a_chunked_log_with_summary_costs_at_most_one_chunk() {
    let bytes = LAYOUTS[2].write();
    let chunks: Vec<_> = records_of(&bytes).into_iter().filter(|record| record.0 == 0x06).collect();
    let largest = 60_usize.div_ceil(chunks.len()) + 4;
    let data_end = records_of(&bytes).iter().find(|record| record.0 == 0x0f).unwrap().1;
    let header_end = chunks[0].1;
    for at in (header_end..data_end).step_by(7) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x40;
        let count = n_readable(&damaged);
        assert!(count + largest >= 60, "a flipped bit at {at} leaves {count} messages of 60");
    }
}

#[test]
fn a_cut_compressed_chunk_gives_its_readable_prefix() {
    for layout in [LAYOUTS[0], LAYOUTS[1]] {
        let options = layout.options().chunk_size(Some(4 << 20));
        let mut writer = TestWriter(options.create(Cursor::new(Vec::new())).unwrap());
        writer.channel(0, "/a");
        (0..1000).for_each(|i| writer.message(1, i, 1_000 + u64::from(i), &payload(i, 1000)));
        let bytes = writer.finish();
        let counts: Vec<usize> =
            [30, 60, 90].iter().map(|percent| n_readable(&bytes[..bytes.len() * percent / 100])).collect();
        assert!(counts[0] > 100 && counts[1] > 450 && counts[2] > 750, "{}: {counts:?}", layout.name);
    }
}
