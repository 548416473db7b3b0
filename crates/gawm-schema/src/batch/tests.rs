use super::*;
use crate::{ContentHash, Unit};

/// Calls `f` with aligned memory of `len` zeros.
fn with_slot<R>(len: usize, f: impl FnOnce(&mut [u8]) -> R) -> R {
    let mut memory = vec![0; len + SECTION_ALIGNMENT];
    let start = memory.as_ptr().align_offset(SECTION_ALIGNMENT);
    f(&mut memory[start..start + len])
}

fn shape() -> BatchShape {
    let (clips, frames, views) = (3, 4, 2);
    BatchShape { clips, frames, views, height: 5, width: 7, channels: 3, action_width: 10, state_width: 3 }
}

fn header(clips: usize) -> SlotHeader {
    SlotHeader {
        schema_hash: ContentHash::of(b"schema"),
        stream_hash: ContentHash::of(b"stream"),
        n: 41,
        batch: BatchId { split: Split::Validation, epoch: 2, step: 1 },
        loader: 1,
        loaders: 2,
        rank: 0,
        ranks: 1,
        clips,
    }
}

/// A small generator, so that the mutations are the same everywhere (splitmix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound as u64) as usize
    }
}

#[test]
fn sections_are_aligned_disjoint_and_in_order() {
    let layout = BatchLayout::try_new(shape()).unwrap();
    let mut end = SLOT_HEADER_BYTES;
    for section in Section::ALL {
        assert_eq!(layout.offset(section) % SECTION_ALIGNMENT, 0, "{}", section.name());
        assert!(layout.offset(section) >= end && layout.offset(section) < end + 64, "{}", section.name());
        end = layout.offset(section) + layout.section_bytes(section);
    }
    assert_eq!(layout.total_bytes(), end.next_multiple_of(64));
    // The bytes of version 1 are fixed: a change here is a change of the format.
    assert_eq!(Section::ALL.map(|s| layout.offset(s)), [320, 384, 2944, 3456, 3648, 3712, 3776]);
    assert_eq!(layout.hash().to_string(), "3ed0e57b71744cd09ab8cf3225f308dbb43d3f4d3d3631859146dd8a868ea44f");
}

fn check_refused_shape(change: impl FnOnce(&mut BatchShape), expected: &str) {
    let mut shape = shape();
    change(&mut shape);
    match BatchLayout::try_new(shape) {
        Err(BatchError::Shape { field, .. }) => assert_eq!(field, expected),
        other => panic!("expected a refusal because of {expected}, got {other:?}"),
    }
}

#[test]
fn impossible_shapes_are_refused() {
    check_refused_shape(|s| s.clips = 0, "clips");
    check_refused_shape(|s| s.action_width = 0, "action_width");
    check_refused_shape(|s| s.height = usize::MAX, "height");
    check_refused_shape(|s| s.channels = 2, "channels");
    check_refused_shape(|s| (s.clips, s.height, s.width) = (1 << 20, 1 << 20, 1 << 20), "bytes of a section");
    check_refused_shape(
        |s| (s.clips, s.frames, s.action_width) = (1 << 20, 1 << 20, 1 << 20),
        "bytes of a section",
    );
    assert!(BatchLayout::try_new(BatchShape { state_width: 0, ..shape() }).is_ok());
}

#[test]
fn every_shape_has_its_own_hash() {
    let hash = |shape| BatchLayout::try_new(shape).unwrap().hash();
    let mut hashes = vec![hash(shape())];
    // Equal offsets, other axes.
    hashes.push(hash(BatchShape { height: 7, width: 5, ..shape() }));
    hashes.push(hash(BatchShape { frames: 2, views: 4, ..shape() }));
    hashes.push(hash(BatchShape { clips: 2, ..shape() }));
    let n = hashes.len();
    hashes.sort();
    hashes.dedup();
    assert_eq!(hashes.len(), n);
}

#[test]
fn what_is_written_is_viewed() {
    let layout = BatchLayout::try_new(shape()).unwrap();
    with_slot(layout.total_bytes() + 100, |slot| {
        let sections = SectionsMut::try_new(&layout, slot).unwrap();
        sections.clip_ids.copy_from_slice(&[7, 8, u64::MAX]);
        sections.frames.iter_mut().enumerate().for_each(|(i, v)| *v = i as u8);
        sections.actions.iter_mut().enumerate().for_each(|(i, v)| *v = i as f32);
        sections.states.iter_mut().enumerate().for_each(|(i, v)| *v = -(i as f32));
        sections.action_mask.fill(1);
        sections.state_mask.fill(2);
        sections.frame_mask.fill(3);
        header(2).write(&layout, slot);
        let view = BatchView::try_new(&layout, slot).unwrap();
        assert_eq!(*view.header(), header(2));
        assert_eq!(*view.shape(), BatchShape { clips: 2, ..shape() });
        assert_eq!(view.clip_ids(), [7, 8]);
        assert_eq!((view.frames().len(), view.frames()[255], view.frames()[256]), (2 * 4 * 2 * 105, 255, 0));
        assert_eq!((view.actions().len(), view.actions()[79]), (80, 79.0));
        assert_eq!((view.states().len(), view.states()[23]), (24, -23.0));
        assert_eq!(view.action_mask(), [1; 8]);
        assert_eq!(view.state_mask(), [2; 24]);
        assert_eq!(view.frame_mask(), [3; 16]);
    });
}

#[test]
fn memory_that_cannot_hold_the_layout_is_refused() {
    let layout = BatchLayout::try_new(shape()).unwrap();
    with_slot(layout.total_bytes() + 64, |slot| {
        header(3).write(&layout, slot);
        let n = layout.total_bytes();
        assert!(matches!(BatchView::try_new(&layout, &slot[..n - 1]), Err(BatchError::Short { .. })));
        assert!(matches!(BatchView::try_new(&layout, &slot[..0]), Err(BatchError::Short { .. })));
        assert!(matches!(BatchView::try_new(&layout, &slot[4..]), Err(BatchError::Unaligned { got: 4 })));
        assert!(matches!(
            SectionsMut::try_new(&layout, &mut slot[8..]),
            Err(BatchError::Unaligned { got: 8 })
        ));
        assert!(BatchView::try_new(&layout, &slot[..n]).is_ok());
    });
}

/// Changes a header in place; the checksum is made good again, so that the field itself is what is found wrong.
fn check_wrong_field(change: impl FnOnce(&mut [u8]), expected: &str) {
    let layout = BatchLayout::try_new(shape()).unwrap();
    with_slot(layout.total_bytes(), |slot| {
        header(3).write(&layout, slot);
        change(slot);
        let checksum = ContentHash::of(&slot[..288]);
        slot[288..320].copy_from_slice(&checksum.0);
        match BatchView::try_new(&layout, slot) {
            Err(BatchError::Header { field, .. }) => assert_eq!(field, expected),
            other => panic!("expected a wrong {expected}, got {other:?}"),
        }
    });
}

#[test]
fn each_wrong_field_is_named() {
    check_wrong_field(|s| s[0] = b'X', "magic");
    check_wrong_field(|s| s[8] = 2, "version");
    check_wrong_field(|s| s[12] = 0, "header length");
    check_wrong_field(|s| s[16] ^= 1, "layout hash");
    check_wrong_field(|s| s[136] = 2, "split");
    check_wrong_field(|s| s[140] = 2, "loader");
    check_wrong_field(|s| s[148] = 9, "rank");
    check_wrong_field(|s| s[156] = 0, "number of clips");
    check_wrong_field(|s| s[156] = 4, "number of clips");
    check_wrong_field(|s| s[160] = 4, "shape");
    check_wrong_field(|s| s[200] ^= 64, "frames");
    check_wrong_field(|s| s[255] = 1, "length");
    let layout = BatchLayout::try_new(shape()).unwrap();
    with_slot(layout.total_bytes(), |slot| {
        header(3).write(&layout, slot);
        slot[112] ^= 1;
        let error = BatchView::try_new(&layout, slot).unwrap_err();
        assert!(matches!(error, BatchError::Header { field: "checksum", .. }), "{error}");
        // A slot that nobody wrote to.
        slot.fill(0);
        let error = BatchView::try_new(&layout, slot).unwrap_err();
        assert!(matches!(error, BatchError::Header { field: "magic", .. }), "{error}");
    });
}

#[test]
fn mutated_slots_never_break_a_view() {
    let layout = BatchLayout::try_new(shape()).unwrap();
    let mut random = Random(20_261_122);
    let (mut accepted, mut refused) = (0, 0);
    with_slot(layout.total_bytes(), |slot| {
        for round in 0..8_000 {
            header(3).write(&layout, slot);
            let is_in_header = round % 2 == 0;
            for _ in 0..1 + random.below(8) {
                let bound = if is_in_header { SLOT_HEADER_BYTES } else { slot.len() };
                let at = random.below(bound);
                slot[at] = random.next() as u8;
            }
            if random.below(2) == 0 {
                let checksum = ContentHash::of(&slot[..288]);
                slot[288..320].copy_from_slice(&checksum.0);
            }
            let end = if random.below(8) == 0 { random.below(slot.len()) } else { slot.len() };
            match BatchView::try_new(&layout, &slot[..end]) {
                Ok(view) => {
                    accepted += 1;
                    touch(&view);
                }
                Err(_) => refused += 1,
            }
        }
    });
    // Both ways are taken, or the test says nothing.
    assert!(accepted > 1000 && refused > 1000, "{accepted} accepted, {refused} refused");
}

/// Reads everything that a view gives access to.
fn touch(view: &BatchView<'_>) {
    let BatchShape { clips, frames, views, action_width, state_width, .. } = *view.shape();
    assert_eq!(view.clip_ids().len(), clips);
    assert_eq!(view.frames().len(), clips * frames * views * view.shape().frame_bytes());
    assert_eq!(view.actions().len(), clips * frames * action_width);
    assert_eq!(view.states().len(), clips * frames * state_width);
    let masks = [view.action_mask(), view.state_mask(), view.frame_mask()];
    let sum: u64 = masks.iter().flat_map(|m| m.iter()).chain(view.frames()).map(|v| u64::from(*v)).sum();
    let numbers: f64 = view.actions().iter().chain(view.states()).map(|v| f64::from(*v)).sum();
    std::hint::black_box((sum, numbers));
}

/// The order as a loop over steps, which the closed form must equal.
fn looped(sequence: &Sequence) -> Vec<BatchId> {
    let mut batches = Vec::new();
    let mut validation = 0;
    for step in 0..sequence.total_steps {
        batches.push(BatchId { split: Split::Train, epoch: step / sequence.steps_per_epoch, step });
        let is_due = sequence.validate_every > 0 && (step + 1) % sequence.validate_every == 0;
        if is_due || step + 1 == sequence.total_steps {
            for step in 0..sequence.validation_batches {
                batches.push(BatchId { split: Split::Validation, epoch: validation, step });
            }
            validation += 1;
        }
    }
    batches
}

#[test]
fn the_sequence_is_the_loop() {
    for total_steps in 0..14 {
        for validate_every in 0..16 {
            for validation_batches in 0..4 {
                let sequence =
                    Sequence { total_steps, validate_every, validation_batches, steps_per_epoch: 3 };
                sequence.check().unwrap();
                let expected = looped(&sequence);
                let got: Vec<_> = (0..).map_while(|n| sequence.batch(n)).collect();
                assert_eq!(got, expected, "{sequence:?}");
                assert_eq!(sequence.batches(), expected.len() as u64);
                for step in 0..total_steps {
                    let n = sequence.position_of_step(step) as usize;
                    assert_eq!((expected[n].split, expected[n].step), (Split::Train, step), "{sequence:?}");
                }
                assert_eq!(sequence.position_of_step(total_steps), expected.len() as u64);
            }
        }
    }
}

#[test]
fn impossible_sequences_are_refused() {
    let sequence = Sequence { total_steps: 4, validate_every: 1, validation_batches: 1, steps_per_epoch: 1 };
    assert_eq!(sequence.check(), Ok(()));
    assert_eq!(Sequence { steps_per_epoch: 0, ..sequence }.check(), Err(SequenceError::NoSteps));
    let long = Sequence { total_steps: 1 << 40, validation_batches: 1 << 40, ..sequence };
    assert!(matches!(long.check(), Err(SequenceError::TooLong { .. })));
    // Unchecked nonsense does not panic either.
    let nonsense = Sequence { total_steps: u64::MAX, validate_every: u64::MAX, ..long };
    assert!(nonsense.batch(u64::MAX - 1).is_some());
}

fn hello() -> Hello {
    let dim = |name: &str| StandardisedDimInfo {
        name: name.to_owned(),
        feature: "x".to_owned(),
        unit: Unit("m".to_owned()),
        mean: 0.1,
        scale: 2.0,
        is_constant: false,
        min: -1.0,
        max: 1.0,
    };
    let feature = |names: &[&str]| EncodedFeature {
        dims: names.iter().map(|n| dim(n)).collect(),
        fitted_on: "train".to_owned(),
        fitted_hash: ContentHash::of(b"episodes"),
    };
    Hello {
        format_version: HELLO_VERSION,
        datasets: vec![DatasetInfo {
            path: "datasets/a".to_owned(),
            content_hash: ContentHash::of(b"content"),
            schema_hash: ContentHash::of(b"schema"),
            share: 1.0,
            rows: 1000,
        }],
        schema_hash: ContentHash::of(b"schema"),
        shape: shape(),
        layout_hash: BatchLayout::try_new(shape()).unwrap().hash(),
        sequence: Sequence { total_steps: 4, validate_every: 1, validation_batches: 1, steps_per_epoch: 1 },
        ranks: 1,
        seed: 3072,
        compat: "repaired".to_owned(),
        frameskip: 5,
        history: 3,
        span: 16,
        rate_hz: 10.0,
        cameras: vec!["front".to_owned(), "wrist".to_owned()],
        state: feature(&["a", "b", "c"]),
        action: feature(&["u", "v"]),
        train: ClipCounts { episodes: 9, clips: 90, excluded: 1, short_episodes: 0 },
        validation: ClipCounts::default(),
        baselines: Baselines { state_variance: vec![1.0, 0.5, 1.0 / 3.0], action_variance: vec![1.0, 1.0] },
    }
}

#[test]
fn hello_round_trips_and_its_hash_ignores_the_path() {
    let hello = hello();
    assert_eq!(Hello::from_json(hello.to_json().as_bytes()), Ok(hello.clone()));
    let mut moved = hello.clone();
    moved.datasets[0].path = "elsewhere".to_owned();
    assert_eq!(moved.stream_hash(), hello.stream_hash());
    let mut other = hello.clone();
    other.seed += 1;
    assert_ne!(other.stream_hash(), hello.stream_hash());
}

fn check_refused_hello(change: impl FnOnce(&mut Hello), expected: &str) {
    let mut hello = hello();
    change(&mut hello);
    let error = Hello::from_json(hello.to_json().as_bytes()).unwrap_err();
    let got = match &error {
        HelloError::Version { .. } => "version",
        HelloError::Syntax { .. } => "syntax",
        HelloError::Shape(_) => "shape",
        HelloError::Sequence(_) => "sequence",
        HelloError::Contradiction { field, .. } => field,
    };
    assert_eq!(got, expected, "{error}");
}

#[test]
fn hello_that_contradicts_itself_is_refused() {
    check_refused_hello(|h| h.format_version = 2, "version");
    check_refused_hello(|h| h.shape.height = 0, "shape");
    check_refused_hello(|h| h.sequence.steps_per_epoch = 0, "sequence");
    check_refused_hello(|h| h.shape.width = 8, "layout_hash");
    check_refused_hello(|h| h.cameras.truncate(1), "number of cameras");
    check_refused_hello(|h| h.state.dims.truncate(1), "number of state dims");
    check_refused_hello(|h| h.frameskip = usize::MAX, "action width");
    check_refused_hello(|h| h.history = 4, "history");
    check_refused_hello(|h| h.action.dims[1].scale = 0.0, "standardisation");
    check_refused_hello(|h| h.state.dims[1].mean = f64::NAN, "syntax");
    check_refused_hello(|h| h.baselines.state_variance.truncate(1), "number of state variances");
    assert!(matches!(Hello::from_json(b"{\"format_version\": 1}"), Err(HelloError::Syntax { .. })));
    assert!(matches!(Hello::from_json(b"\xff"), Err(HelloError::Syntax { .. })));
}
