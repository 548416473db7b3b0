//! A live slot read from Python, with numpy over the memory and nothing of ours in between; and where its memory lies.
#![expect(clippy::unwrap_used, reason = "a test that cannot set up has failed")]

mod fixture;

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use gawm_schema::ContentHash;
use gawm_schema::batch::{BatchView, Section};
use gawm_shm::{Claim, Place, Slot, Subscriber};

fn in_60_s() -> Instant {
    Instant::now() + Duration::from_secs(60)
}

fn start_loader(data: &Path, place: &Place, settings: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gawm-loader"));
    command.args(["run", "--service", "live", "--total-steps", "10", "--quiet", "--data"]).arg(data);
    settings.iter().for_each(|setting| {
        command.args(["--set", setting]);
    });
    command.arg("--shm-root").arg(place.root()).stdin(Stdio::null()).spawn().unwrap()
}

/// Holds batch `n` of a loader process while `look` runs.
fn with_live_slot(settings: &[&str], n: u64, look: impl FnOnce(&Place, &Slot, &Child, u64)) {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    fixture::write(&data, &fixture::plans());
    let place = Place::at(&folder.path().join("shm"));
    // Writing the dataset above leaves memory with the allocator.
    let own_kib = status_kib("self", "RssAnon:");
    let claim = Claim::take(&place, "live", in_60_s()).unwrap();
    let mut subscriber: Subscriber = claim.subscribe(0, 1, in_60_s()).unwrap();
    let mut child = start_loader(&data, &place, settings);
    for before in 0..n {
        drop(subscriber.next(before, in_60_s()).unwrap());
    }
    let slot = subscriber.next(n, in_60_s()).unwrap();
    look(&place, &slot, &child, own_kib);
    drop((slot, subscriber, claim));
    assert!(child.wait().unwrap().success());
}

/// A Python with numpy, if there is one.
fn python() -> Option<String> {
    let candidates = [std::env::var("GAWM_PYTHON").ok(), Some("python3".to_owned())];
    let has_numpy = |program: &String| {
        let output = Command::new(program).args(["-c", "import numpy"]).output();
        output.is_ok_and(|output| output.status.success())
    };
    candidates.into_iter().flatten().find(has_numpy)
}

fn section(view: &BatchView<'_>, section: Section) -> Vec<u8> {
    match section {
        Section::ClipIds => view.clip_ids().iter().flat_map(|id| id.to_le_bytes()).collect(),
        Section::Frames => view.frames().to_vec(),
        Section::Actions => view.actions().iter().flat_map(|v| v.to_le_bytes()).collect(),
        Section::States => view.states().iter().flat_map(|v| v.to_le_bytes()).collect(),
        Section::ActionMask => view.action_mask().to_vec(),
        Section::StateMask => view.state_mask().to_vec(),
        Section::FrameMask => view.frame_mask().to_vec(),
    }
}

#[test]
fn python_reads_a_live_slot() {
    let Some(python) = python() else {
        println!("skipped: there is no python3 with numpy (GAWM_PYTHON names another)");
        return;
    };
    with_live_slot(&["loader.batch=5"], 7, |place, slot, _, _| {
        let out = tempfile::tempdir().unwrap();
        let root = std::fs::canonicalize(place.root()).unwrap();
        let hash = ContentHash::of(root.to_string_lossy().as_bytes()).to_string();
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/read_slot.py");
        let mut command = Command::new(&python);
        command.arg(script).arg(format!("gawm_{}_", &hash[..8])).arg("7").arg(out.path());
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let header: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let view = slot.view().unwrap();
        assert_eq!(header["n"], 7);
        assert_eq!(header["step"], view.header().batch.step);
        assert_eq!(header["split"], view.header().batch.split.code());
        assert_eq!(header["shape"], serde_json::json!([5, 4, 2, 12, 16, 3, 10, 4]));
        for part in Section::ALL {
            let got = std::fs::read(out.path().join(format!("{}.bin", part.name()))).unwrap();
            assert!(got == section(&view, part), "{}", part.name());
        }
    });
}

fn status_kib(process: &str, field: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with(field)).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

#[test]
fn a_large_batch_takes_no_memory_of_either_process() {
    // 28 clips x 4 frames x 2 cameras x 224 x 224 x 3 bytes = 33.7 MB; three slots are 101 MB.
    let settings = ["loader.batch=28", "loader.image_size=[224, 224]"];
    with_live_slot(&settings, 1, |_, slot, loader, before| {
        let view = slot.view().unwrap();
        let sum: u64 = view.frames().iter().map(|v| u64::from(*v)).sum();
        assert!(sum > 0 && view.frames().len() > 33_000_000);
        let batch_kib = (slot.len() / 1024) as u64;
        let grown = status_kib("self", "RssAnon:").saturating_sub(before);
        assert!(grown < batch_kib / 4, "the trainer's own memory grew by {grown} KiB for {batch_kib} KiB");
        assert!(status_kib("self", "RssShmem:") > batch_kib / 2);
        // The loader decodes into the slot: all it has of its own is an index and one frame.
        let own = status_kib(&loader.id().to_string(), "RssAnon:");
        assert!(own < batch_kib / 2, "the loader has {own} KiB of its own for {batch_kib} KiB");
        // The view lies in a shared mapping of a file in /dev/shm.
        let address = view.frames().as_ptr().addr();
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        let holds = |line: &&str| {
            let (from, rest) = line.split_once('-').unwrap();
            let to = rest.split(' ').next().unwrap();
            let [from, to] = [from, to].map(|digits| usize::from_str_radix(digits, 16).unwrap());
            (from..to).contains(&address)
        };
        let mapping = maps.lines().find(holds).unwrap();
        assert!(mapping.contains("s ") && mapping.contains("/dev/shm/gawm_"), "{mapping}");
    });
}
