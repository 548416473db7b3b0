//! Loaders and trainers that are killed (SIGKILL) at drawn moments: the stream of batches stays the undisturbed one, and
//! nothing stays in shared memory.
//!
//! `GAWM_KILLS=100 cargo test -p gawm-loader --test kill` kills so many of each; the default is quick. `GAWM_KILL_SEED` draws
//! other moments. Nothing waits for a time to pass: moments are drawn as deadlines of waits and as numbers of batches.
#![expect(clippy::unwrap_used, reason = "a test that cannot set up has failed")]

mod fixture;

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use gawm_loader::{BatchMaker, Index, LoaderConfig, RunLength};
use gawm_schema::ContentHash;
use gawm_schema::batch::{BatchView, Sequence};
use gawm_shm::{Claim, Place, ShmError, Subscriber};

const LOADERS: u32 = 2;
const SERVICE: &str = "kill";
/// Larger than the dataset's frames, so that a good part of a loader's time is decoding and resizing.
const SIZE: [usize; 2] = [96, 96];

fn run_length() -> RunLength {
    RunLength { total_steps: 60, validate_every: 25, validation_batches: 2, ..RunLength::default() }
}

fn config() -> LoaderConfig {
    LoaderConfig { batch: 6, image_size: Some(SIZE), loaders: LOADERS, slots: 2, ..LoaderConfig::default() }
}

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

/// splitmix64, so that a seed draws the same moments everywhere.
struct Random(u64);

impl Random {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ z >> 31) % bound
    }
}

fn in_60_s() -> Instant {
    Instant::now() + Duration::from_secs(60)
}

/// Everything a reader can see of a batch.
fn hash(view: &BatchView<'_>) -> ContentHash {
    let mut hasher = view.frames().to_vec();
    hasher.extend(format!("{:?} {:?}", view.header().batch, view.clip_ids()).into_bytes());
    hasher.extend(view.actions().iter().chain(view.states()).flat_map(|v| v.to_le_bytes()));
    hasher.extend([view.action_mask(), view.state_mask(), view.frame_mask()].concat());
    ContentHash::of(&hasher)
}

/// The hashes of all batches, made without any other process.
fn undisturbed(data: &Path) -> Vec<ContentHash> {
    let index = Index::build(&[data.to_owned()], &config(), run_length()).unwrap();
    let maker = BatchMaker::new(&index, None, 0, 1).unwrap();
    let layout = index.layout();
    let mut memory = vec![0; layout.total_bytes() + 64];
    let start = memory.as_ptr().align_offset(64);
    let slot = &mut memory[start..start + layout.total_bytes()];
    let batches = 0..index.hello().sequence.batches();
    let made = batches.map(|n| {
        maker.fill(n, slot, &AtomicBool::new(false)).unwrap().write(layout, slot);
        hash(&BatchView::try_new(layout, slot).unwrap())
    });
    made.collect()
}

/// Folders of a test.
struct Bench {
    _folder: tempfile::TempDir,
    data: PathBuf,
    place: Place,
}

impl Bench {
    fn new() -> Bench {
        let folder = tempfile::tempdir().unwrap();
        let data = folder.path().join("data");
        fixture::write(&data, &fixture::plans());
        let place = Place::at(&folder.path().join("shm"));
        std::fs::create_dir(place.root()).unwrap();
        Bench { data, place, _folder: folder }
    }

    /// Names of the files of this place in shared memory.
    fn shm_files(&self) -> Vec<String> {
        let root = std::fs::canonicalize(self.place.root()).unwrap();
        let hash = ContentHash::of(root.to_string_lossy().as_bytes()).to_string();
        let prefix = format!("gawm_{}_", &hash[..8]);
        let entries = std::fs::read_dir("/dev/shm").unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned());
        names.filter(|name| name.starts_with(&prefix)).collect()
    }

    fn clean(&self) {
        let root = self.place.root().to_str().unwrap();
        let output = loader_program().args(["clean", "--shm-root", root]).output().unwrap();
        assert!(output.status.success(), "{output:?}");
    }
}

fn loader_program() -> Command {
    Command::new(env!("CARGO_BIN_EXE_gawm-loader"))
}

fn start_loader(data: &Path, place: &Place, token: &str, loader: u32, start: u64) -> Child {
    let length = run_length();
    let mut command = loader_program();
    command.args(["run", "--service", SERVICE, "--token", token, "--data"]).arg(data);
    command.args(["--loader", &loader.to_string(), "--loaders", &LOADERS.to_string()]);
    command.args(["--start", &start.to_string(), "--total-steps", &length.total_steps.to_string()]);
    command.args(["--validate-every", &length.validate_every.to_string()]);
    command.args(["--validation-batches", &length.validation_batches.to_string()]);
    command.args([
        "--set",
        "loader.batch=6",
        "--set",
        &format!("loader.image_size=[{}, {}]", SIZE[0], SIZE[1]),
    ]);
    command.args(["--set", "loader.slots=2", "--quiet", "--shm-root"]).arg(place.root());
    command.stdin(Stdio::null()).spawn().unwrap()
}

/// A trainer that only takes batches, and starts loaders again that were killed.
struct Trainer<'a> {
    data: &'a Path,
    place: &'a Place,
    // Dropped in this order: subscribers before the claim.
    loaders: BTreeMap<u32, (Subscriber, Child)>,
    claim: Claim,
    restarts: u64,
}

impl<'a> Trainer<'a> {
    fn new(data: &'a Path, place: &'a Place, start: u64) -> Trainer<'a> {
        let claim = Claim::take(place, SERVICE, in_60_s()).unwrap();
        let mut trainer = Trainer { data, place, loaders: BTreeMap::new(), claim, restarts: 0 };
        (0..LOADERS).for_each(|loader| trainer.start(loader, start));
        trainer
    }

    fn start(&mut self, loader: u32, n: u64) {
        // The subscriber goes first: what it holds belongs to the loader that is gone.
        if let Some((subscriber, mut child)) = self.loaders.remove(&loader) {
            drop(subscriber);
            let status = child.wait().unwrap();
            assert!(status.code().is_none(), "loader {loader} ended by itself: {status}");
            self.restarts += 1;
        }
        let subscriber = self.claim.subscribe(loader, LOADERS, in_60_s()).unwrap();
        let child = start_loader(self.data, self.place, subscriber.token(), loader, n);
        self.loaders.insert(loader, (subscriber, child));
    }

    fn sequence(&mut self) -> Sequence {
        loop {
            let (subscriber, child) = self.loaders.get_mut(&0).unwrap();
            match subscriber.hello(Instant::now() + Duration::from_millis(200)) {
                Ok(hello) => return hello.sequence,
                Err(ShmError::Timeout { .. }) if child.try_wait().unwrap().is_none() => {}
                Err(ShmError::Timeout { .. }) => self.start(0, 0),
                Err(error) => panic!("{error}"),
            }
        }
    }

    /// Takes batch n within a time, or returns `None`.
    fn take_within(&mut self, n: u64, patience: Duration) -> Option<ContentHash> {
        let deadline = Instant::now() + patience;
        let loader = (n % u64::from(LOADERS)) as u32;
        loop {
            let (subscriber, child) = self.loaders.get_mut(&loader).unwrap();
            match subscriber.next(n, deadline.min(Instant::now() + Duration::from_millis(200))) {
                Ok(slot) => return Some(hash(&slot.view().unwrap())),
                Err(ShmError::LoaderGone { .. }) => self.start(loader, n),
                // One that is killed before its hello is only known as a process that has ended.
                Err(ShmError::Timeout { .. }) if child.try_wait().unwrap().is_some() => self.start(loader, n),
                Err(ShmError::Timeout { .. }) if Instant::now() >= deadline => return None,
                Err(ShmError::Timeout { .. }) => {}
                Err(error) => panic!("batch {n}: {error}"),
            }
        }
    }

    fn kill(&mut self, loader: u32) {
        self.loaders.get_mut(&loader).unwrap().1.kill().unwrap();
    }

    /// Waits for loaders that have made everything.
    fn finish(mut self) {
        for (_, child) in self.loaders.values_mut() {
            let status = child.wait().unwrap();
            // Killed after its last batch, or done.
            assert!(status.success() || status.code().is_none(), "{status}");
        }
    }
}

#[test]
fn loaders_killed_at_any_moment_change_nothing() {
    let bench = Bench::new();
    let expected = undisturbed(&bench.data);
    let mut random = Random(number("GAWM_KILL_SEED", 3072));
    let mut left = number("GAWM_KILLS", 6);
    let (mut restarts, mut kills) = (0, 0);
    // A run is short; many kills take several.
    while left > 0 {
        let mut trainer = Trainer::new(&bench.data, &bench.place, 0);
        assert_eq!(trainer.sequence().batches(), expected.len() as u64);
        let mut n = 0;
        while n < expected.len() as u64 {
            // From the first instructions of a process to the middle of a later batch.
            if left > 0 && random.below(6) == 0 {
                let victim = random.below(u64::from(LOADERS)) as u32;
                let moment = Duration::from_micros(random.below(40_000));
                if let Some(got) = trainer.take_within(n, moment) {
                    assert_eq!(got, expected[n as usize], "batch {n}");
                    n += 1;
                }
                trainer.kill(victim);
                (left, kills) = (left - 1, kills + 1);
                continue;
            }
            let got = trainer.take_within(n, Duration::from_secs(60)).expect("a batch");
            assert_eq!(got, expected[n as usize], "batch {n}");
            n += 1;
        }
        restarts += trainer.restarts;
        trainer.finish();
        bench.clean();
        assert_eq!(bench.shm_files(), Vec::<String>::new());
    }
    eprintln!("{kills} loaders killed, {restarts} started again");
}

/// Not a test of its own: the trainer that the next test kills, in a process of its own.
#[test]
fn trainer_process() {
    let Ok(folder) = std::env::var("GAWM_KILL_TRAINER") else { return };
    let (data, root) = (Path::new(&folder).join("data"), Path::new(&folder).join("shm"));
    let place = Place::at(&root);
    let start = number("GAWM_KILL_START", 0);
    let mut trainer = Trainer::new(&data, &place, start);
    for n in start..trainer.sequence().batches() {
        let hash = trainer.take_within(n, Duration::from_secs(60)).expect("a batch");
        // Past the capture of the test harness.
        writeln!(std::io::stderr(), "batch {n} {hash}").unwrap();
    }
    trainer.finish();
}

fn start_trainer(folder: &Path, start: u64) -> Child {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "trainer_process", "--nocapture"]);
    command.env("GAWM_KILL_TRAINER", folder).env("GAWM_KILL_START", start.to_string());
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

#[test]
fn trainers_killed_at_any_moment_resume() {
    let bench = Bench::new();
    let expected = undisturbed(&bench.data);
    let mut random = Random(number("GAWM_KILL_SEED", 3072) + 1);
    let mut left = number("GAWM_KILLS", 6).div_ceil(2);
    let folder = bench.data.parent().unwrap().to_owned();
    let (mut n, mut kills) = (0, 0);
    loop {
        let mut child = start_trainer(&folder, n);
        // Killed after so many batches, 0 meaning while it starts; or left alone.
        let lifetime = if left > 0 { random.below(12) } else { u64::MAX };
        let lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let mut lived = 0;
        if lifetime > 0 {
            for line in lines {
                let line = line.unwrap();
                let Some(text) = line.strip_prefix("batch ") else { continue };
                let expected = format!("{n} {}", expected[n as usize]);
                assert_eq!(text, expected);
                (n, lived) = (n + 1, lived + 1);
                if lived == lifetime {
                    break;
                }
            }
        }
        if left > 0 {
            child.kill().unwrap();
            (left, kills) = (left - 1, kills + 1);
        }
        let status = child.wait().unwrap();
        if n == expected.len() as u64 {
            break;
        }
        assert!(status.code().is_none(), "the trainer ended by itself at batch {n}: {status}");
        if left > 0 && n + 12 >= expected.len() as u64 {
            // Near the end: begin anew, so that there is something left to disturb.
            n = 0;
        }
    }
    // The last trainer may have been killed too; its loaders end by themselves, and taking the name waits for that.
    drop(Claim::take(&bench.place, SERVICE, in_60_s()).unwrap());
    assert_eq!(bench.shm_files(), Vec::<String>::new());
    eprintln!("{kills} trainers killed");
}

#[test]
fn clean_leaves_the_living_alone() {
    let bench = Bench::new();
    let mut trainer = Trainer::new(&bench.data, &bench.place, 0);
    // Both loaders have connected.
    (0..2).for_each(|n| assert!(trainer.take_within(n, Duration::from_secs(60)).is_some()));
    let before = bench.shm_files();
    bench.clean();
    assert_eq!(bench.shm_files(), before);
    assert!(!before.is_empty());
    assert!(trainer.take_within(2, Duration::from_secs(60)).is_some());
    // A trainer that leaves early: its loaders notice and end with success.
    let Trainer { mut loaders, claim, .. } = trainer;
    let children: Vec<Child> = std::mem::take(&mut loaders).into_values().map(|(_, child)| child).collect();
    drop(claim);
    for mut child in children {
        let status = child.wait().unwrap();
        assert!(status.success(), "{status}");
    }
    bench.clean();
    assert_eq!(bench.shm_files(), Vec::<String>::new());
}
