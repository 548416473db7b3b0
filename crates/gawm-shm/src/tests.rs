use std::time::{Duration, Instant};

use gawm_schema::batch::*;
use gawm_schema::{ContentHash, Unit};

use crate::{Claim, Place, Publisher, PublisherOptions, ShmError, SlotMut, Subscriber};

/// A wait that a working pair never needs.
fn in_30_s() -> Instant {
    Instant::now() + Duration::from_secs(30)
}

fn now() -> Instant {
    Instant::now()
}

fn place() -> (tempfile::TempDir, Place) {
    let folder = tempfile::tempdir().unwrap();
    let place = Place::at(folder.path());
    (folder, place)
}

fn hello(shape: BatchShape) -> Hello {
    let dim = |i: usize| StandardisedDimInfo {
        name: format!("d{i}"),
        feature: "x".to_owned(),
        unit: Unit("m".to_owned()),
        mean: 0.0,
        scale: 1.0,
        is_constant: false,
        min: -1.0,
        max: 1.0,
    };
    let feature = |width: usize| EncodedFeature {
        dims: (0..width).map(dim).collect(),
        fitted_on: "train".to_owned(),
        fitted_hash: ContentHash::of(b""),
    };
    Hello {
        format_version: HELLO_VERSION,
        datasets: Vec::new(),
        schema_hash: ContentHash::of(b"schema"),
        shape,
        layout_hash: BatchLayout::try_new(shape).unwrap().hash(),
        sequence: Sequence {
            total_steps: 1000,
            validate_every: 0,
            validation_batches: 1,
            steps_per_epoch: 10,
        },
        ranks: 1,
        seed: 1,
        compat: "repaired".to_owned(),
        frameskip: 1,
        history: 1,
        span: 2,
        rate_hz: 10.0,
        cameras: vec!["front".to_owned()],
        state: feature(shape.state_width),
        action: feature(shape.action_width),
        train: ClipCounts::default(),
        validation: ClipCounts::default(),
        baselines: Baselines {
            state_variance: vec![1.0; shape.state_width],
            action_variance: vec![1.0; shape.action_width],
        },
    }
}

fn small() -> BatchShape {
    let (height, width) = (8, 8);
    BatchShape { clips: 2, frames: 2, views: 1, height, width, channels: 3, action_width: 2, state_width: 1 }
}

fn header(hello: &Hello, n: u64) -> SlotHeader {
    SlotHeader {
        schema_hash: hello.schema_hash,
        stream_hash: hello.stream_hash(),
        n,
        batch: hello.sequence.batch(n).unwrap(),
        loader: 0,
        loaders: 1,
        rank: 0,
        ranks: 1,
        clips: hello.shape.clips,
    }
}

const SLOTS: usize = 3;

fn options() -> PublisherOptions {
    PublisherOptions { loader: 0, loaders: 1, slots: SLOTS, token: None }
}

/// A trainer's and a loader's side in one process.
fn pair(place: &Place, hello: &Hello) -> (Claim, Subscriber, Publisher) {
    let claim = Claim::take(place, "pair", in_30_s()).unwrap();
    let subscriber = claim.subscribe(0, 1, in_30_s()).unwrap();
    let publisher = Publisher::connect(place, "pair", hello, options(), in_30_s()).unwrap();
    (claim, subscriber, publisher)
}

fn fill(publisher: &Publisher, slot: &mut SlotMut, n: u64) {
    let sections = SectionsMut::try_new(publisher.layout(), slot).unwrap();
    sections.clip_ids.fill(n);
    sections.frames.fill(n as u8);
    sections.actions.fill(n as f32);
    sections.states.fill(-(n as f32));
    sections.action_mask.fill(1);
    sections.state_mask.fill(1);
    sections.frame_mask.fill(1);
}

fn publish(publisher: &mut Publisher, hello: &Hello, n: u64) {
    let mut slot = publisher.loan(in_30_s()).unwrap();
    fill(publisher, &mut slot, n);
    publisher.publish(slot, &header(hello, n)).unwrap();
}

/// Lists what the place has in `/dev/shm`.
fn shm_files(place: &Place) -> Vec<String> {
    let prefix = place.place_prefix();
    let entries = std::fs::read_dir("/dev/shm").unwrap();
    let names = entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned());
    names.filter(|name| name.starts_with(&prefix)).collect()
}

#[test]
fn batches_arrive_in_order_and_credits_return() {
    let (_folder, place) = place();
    let hello = hello(small());
    let (claim, mut subscriber, mut publisher) = pair(&place, &hello);
    assert_eq!(*subscriber.hello(in_30_s()).unwrap(), hello);
    for n in 0..100 {
        publish(&mut publisher, &hello, n);
        let slot = subscriber.next(n, in_30_s()).unwrap();
        let view = slot.view().unwrap();
        assert_eq!(view.header().n, n);
        assert_eq!(view.clip_ids(), [n; 2]);
        assert!(view.frames().iter().all(|v| *v == n as u8));
        assert!(view.states().iter().all(|v| *v == -(n as f32)));
        assert_eq!(view.frames().as_ptr().addr() % 64, 0);
    }
    assert_eq!(publisher.credits().unwrap(), SLOTS);
    publisher.drain(in_30_s()).unwrap();
    drop((publisher, subscriber, claim));
    assert_eq!(shm_files(&place), Vec::<String>::new());
    assert_eq!(std::fs::read_dir(place.root()).unwrap().count(), 0);
}

#[test]
fn without_credit_there_is_no_slot_and_nothing_is_lost() {
    let (_folder, place) = place();
    let hello = hello(small());
    let (_claim, mut subscriber, mut publisher) = pair(&place, &hello);
    subscriber.hello(in_30_s()).unwrap();
    for n in 0..SLOTS as u64 {
        publish(&mut publisher, &hello, n);
    }
    assert_eq!(publisher.credits().unwrap(), 0);
    assert!(matches!(publisher.loan(now()), Err(ShmError::Timeout { what: "free slot", .. })));
    // Held views count against the credits, and stay as they are while the next batches are made.
    let first = subscriber.next(0, in_30_s()).unwrap();
    let second = subscriber.next(1, in_30_s()).unwrap();
    assert!(matches!(publisher.loan(now()), Err(ShmError::Timeout { .. })));
    drop(first);
    publish(&mut publisher, &hello, 3);
    assert_eq!(second.view().unwrap().clip_ids(), [1, 1]);
    drop(second);
    for n in 2..4 {
        assert_eq!(subscriber.next(n, in_30_s()).unwrap().view().unwrap().clip_ids(), [n, n]);
    }
    assert!(matches!(subscriber.next(4, now()), Err(ShmError::Timeout { what: "batch", .. })));
}

#[test]
fn a_queued_batch_outlives_its_loader() {
    let (_folder, place) = place();
    let hello = hello(small());
    let (_claim, mut subscriber, mut publisher) = pair(&place, &hello);
    publish(&mut publisher, &hello, 0);
    publish(&mut publisher, &hello, 1);
    let held = subscriber.next(0, in_30_s()).unwrap();
    drop(publisher);
    assert_eq!(held.view().unwrap().clip_ids(), [0, 0]);
    assert_eq!(subscriber.next(1, in_30_s()).unwrap().view().unwrap().clip_ids(), [1, 1]);
    assert!(matches!(subscriber.next(2, in_30_s()), Err(ShmError::LoaderGone { loader: 0, .. })));
    assert_eq!(held.view().unwrap().clip_ids(), [0, 0]);
}

#[test]
fn a_loader_starts_again_where_the_trainer_is() {
    let (_folder, place) = place();
    let hello = hello(small());
    let (claim, mut subscriber, mut publisher) = pair(&place, &hello);
    subscriber.hello(in_30_s()).unwrap();
    for n in 0..3 {
        publish(&mut publisher, &hello, n);
    }
    drop(subscriber.next(0, in_30_s()).unwrap());
    drop(publisher);
    drop(subscriber);
    let mut subscriber = claim.subscribe(0, 1, in_30_s()).unwrap();
    let mut publisher = Publisher::connect(&place, "pair", &hello, options(), in_30_s()).unwrap();
    publish(&mut publisher, &hello, 1);
    assert_eq!(subscriber.next(1, in_30_s()).unwrap().view().unwrap().clip_ids(), [1, 1]);
}

#[test]
fn a_loader_notices_that_its_trainer_is_gone() {
    let (_folder, place) = place();
    let hello = hello(small());
    let (claim, subscriber, mut publisher) = pair(&place, &hello);
    drop((subscriber, claim));
    // The hello and two batches are on their way to nobody; then the credits are used up.
    let error = loop {
        match publisher.loan(in_30_s()) {
            Ok(slot) => match publisher.publish(slot, &header(&hello, 0)) {
                Ok(()) => {}
                Err(error) => break error,
            },
            Err(error) => break error,
        }
    };
    assert!(matches!(error, ShmError::TrainerGone { .. }), "{error}");
    drop(publisher);
    assert_eq!(shm_files(&place), Vec::<String>::new());
}

#[test]
fn names_and_numbers_are_taken_once() {
    let (_folder, place) = place();
    let hello = hello(small());
    let (_claim, _subscriber, _publisher) = pair(&place, &hello);
    let me = std::process::id().to_string();
    match Claim::take(&place, "pair", now()) {
        Err(ShmError::NameInUse { name, process }) => {
            assert_eq!((name, process), ("pair".to_owned(), me.clone()))
        }
        other => panic!("expected the name to be in use, got {other:?}"),
    }
    match Publisher::connect(&place, "pair", &hello, options(), now()) {
        Err(ShmError::LoaderInUse { loader: 0, process, .. }) => assert_eq!(process, me),
        other => panic!("expected the loader to be in use, got {other:?}"),
    }
    for name in ["", "a/b", "..", ".hidden", "ü", &"x".repeat(65)] {
        assert!(matches!(Claim::take(&place, name, now()), Err(ShmError::BadName { .. })), "{name}");
    }
}

#[test]
fn a_loader_of_another_trainer_leaves() {
    let (_folder, place) = place();
    let claim = Claim::take(&place, "pair", in_30_s()).unwrap();
    let earlier = claim.subscribe(0, 1, in_30_s()).unwrap().token().to_owned();
    let connect = |token: &str| {
        let options = PublisherOptions { token: Some(token.to_owned()), ..options() };
        Publisher::connect(&place, "pair", &hello(small()), options, in_30_s())
    };
    // Its subscriber is gone, then there is a newer one.
    assert!(matches!(connect(&earlier), Err(ShmError::TrainerGone { .. })));
    let subscriber = claim.subscribe(0, 1, in_30_s()).unwrap();
    assert!(matches!(connect(&earlier), Err(ShmError::TrainerGone { .. })));
    assert!(connect(subscriber.token()).is_ok());
}

#[test]
fn a_loader_without_a_trainer_says_so() {
    let (_folder, place) = place();
    let error = Publisher::connect(&place, "nobody", &hello(small()), options(), now()).unwrap_err();
    assert!(matches!(error, ShmError::NoTrainer { .. }), "{error}");
    assert_eq!(place.clean().unwrap().removed, ["nobody"]);
}

#[test]
fn too_little_shared_memory_is_said_before_anything_is_made() {
    let (_folder, place) = place();
    let huge = BatchShape { clips: 1 << 13, height: 1000, width: 1000, ..small() };
    let claim = Claim::take(&place, "huge", in_30_s()).unwrap();
    let slots = crate::MAX_SLOTS;
    let _subscriber = claim.subscribe(0, 1, in_30_s()).unwrap();
    let options = PublisherOptions { slots, ..options() };
    match Publisher::connect(&place, "huge", &hello(huge), options, in_30_s()) {
        Err(ShmError::NoRoom { needed, available, slots: 16, .. }) => assert!(needed > available),
        other => panic!("expected too little room, got {other:?}"),
    }
}

/// Publishes one batch with a changed header or content and returns what the trainer says.
fn refusal(change: impl FnOnce(&mut SlotHeader), spoil: impl FnOnce(&mut [u8])) -> ShmError {
    let (_folder, place) = place();
    let hello = hello(small());
    let (_claim, mut subscriber, mut publisher) = pair(&place, &hello);
    subscriber.hello(in_30_s()).unwrap();
    let mut slot = publisher.loan(in_30_s()).unwrap();
    fill(&publisher, &mut slot, 0);
    let mut header = header(&hello, 0);
    change(&mut header);
    header.write(publisher.layout(), &mut slot);
    spoil(&mut slot);
    publisher.send(slot).unwrap();
    subscriber.next(0, in_30_s()).unwrap_err()
}

fn check_out_of_sequence(change: impl FnOnce(&mut SlotHeader), expected: &str) {
    match refusal(change, |_| {}) {
        ShmError::Sequence { field, .. } => assert_eq!(field, expected),
        other => panic!("expected a wrong {expected}, got {other:?}"),
    }
}

#[test]
fn a_batch_that_is_not_due_is_refused() {
    check_out_of_sequence(|h| h.schema_hash = ContentHash::of(b"other"), "schema hash");
    check_out_of_sequence(|h| h.stream_hash = ContentHash::of(b"other"), "stream hash");
    check_out_of_sequence(|h| h.n = 1, "position");
    check_out_of_sequence(|h| h.batch.step = 1, "batch");
    check_out_of_sequence(|h| h.loaders = 2, "loader");
    check_out_of_sequence(|h| h.ranks = 2, "number of ranks");
    let torn = refusal(|_| {}, |slot| slot[100] ^= 1);
    assert!(matches!(torn, ShmError::Batch { .. }), "{torn}");
    let foreign = refusal(|_| {}, |slot| slot[..8].copy_from_slice(b"NOTOURS!"));
    assert!(matches!(foreign, ShmError::Batch { .. }), "{foreign}");
}

/// Sends other bytes than a hello and returns what the trainer says.
fn greeting_refusal(spoil: impl FnOnce(&mut [u8])) -> ShmError {
    let json = hello(small()).to_json();
    let mut bytes = vec![0; crate::greeting::length(&json) + 64];
    crate::greeting::write(&json, &mut bytes);
    assert!(crate::greeting::read(0, &bytes).is_ok());
    spoil(&mut bytes);
    crate::greeting::read(0, &bytes).unwrap_err()
}

#[test]
fn a_foreign_or_older_publisher_is_named() {
    let is_foreign = |error: ShmError| assert!(matches!(error, ShmError::Foreign { .. }), "{error}");
    is_foreign(greeting_refusal(|b| b[0] = 0));
    is_foreign(greeting_refusal(|b| b[8] = 2));
    is_foreign(greeting_refusal(|b| b[16..24].fill(0xff)));
    is_foreign(greeting_refusal(|b| b[200] ^= 1));
    is_foreign(crate::greeting::read(0, &[0; 10]).unwrap_err());
    let older = greeting_refusal(|b| {
        let mut other = hello(small());
        other.format_version = 0;
        crate::greeting::write(&other.to_json(), b);
    });
    assert!(matches!(older, ShmError::Hello { source: HelloError::Version { got: 0 }, .. }), "{older}");
}

/// The mapping of this process that holds an address: (path, whether it is shared).
fn mapping_of(address: usize) -> (String, bool) {
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    for line in maps.lines() {
        let mut fields = line.split_whitespace();
        let (range, permissions) = (fields.next().unwrap(), fields.next().unwrap());
        let (from, to) = range.split_once('-').unwrap();
        let bounds = [from, to].map(|digits| usize::from_str_radix(digits, 16).unwrap());
        if (bounds[0]..bounds[1]).contains(&address) {
            return (fields.nth(3).unwrap_or("").to_owned(), permissions.ends_with('s'));
        }
    }
    panic!("no mapping holds {address:#x}");
}

#[test]
fn views_point_into_shared_memory() {
    let (_folder, place) = place();
    let hello = hello(small());
    let (_claim, mut subscriber, mut publisher) = pair(&place, &hello);
    publish(&mut publisher, &hello, 0);
    let slot = subscriber.next(0, in_30_s()).unwrap();
    let view = slot.view().unwrap();
    let ours = format!("/dev/shm/{}", place.place_prefix());
    for address in [
        view.frames().as_ptr().addr(),
        view.frames().as_ptr_range().end.addr() - 1,
        view.actions().as_ptr().addr(),
        view.states().as_ptr().addr(),
        view.frame_mask().as_ptr().addr(),
    ] {
        let (path, is_shared) = mapping_of(address);
        assert!(path.starts_with(&ours) && is_shared, "{address:#x} lies in {path:?}");
    }
}
