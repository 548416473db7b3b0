//! The loader processes of a run: started, watched, started again, ended.

mod command;

use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use gawm_schema::batch::Hello;
use gawm_shm::{Claim, Place, ShmError, Slot, Subscriber};
use thiserror::Error;

use crate::interrupt::Interrupt;
use crate::source::{BatchSource, SourceError};

pub use command::{LoaderCommand, LoaderProgram};

/// Time between two looks at the child and at Ctrl-C while waiting for a batch.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// How often a loader is started again without a single batch in between.
const MAX_RESTARTS: u32 = 5;

/// How loaders are run.
#[derive(Debug, Clone)]
pub struct LoaderOptions {
    /// How a loader is started; `None`: somebody else starts them.
    pub command: Option<LoaderCommand>,
    /// Name of the service.
    pub service: String,
    /// Number of loaders.
    pub loaders: u32,
    /// Longest wait for a loader to connect, or for a batch.
    pub patience: Duration,
    /// Says what happens to loaders, one line at a time.
    pub say: fn(&str),
}

/// Why loaders do not deliver.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LoaderError {
    /// The way between the processes failed.
    #[error(transparent)]
    Shm(#[from] ShmError),
    /// A loader cannot be started.
    #[error("cannot start loader {loader} ({program:?}): {cause}")]
    Start {
        /// Its number.
        loader: u32,
        /// The program.
        program: std::path::PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// A loader refused to work; what it said is on stderr.
    #[error("loader {loader} ended before batch {n}: expected it to run, got {status}")]
    Ended {
        /// Its number.
        loader: u32,
        /// The batch that was due.
        n: u64,
        /// How it ended.
        status: ExitStatus,
    },
    /// A loader dies again and again.
    #[error("loader {loader} was killed {times} times without making batch {n}, the last time by {status}")]
    DiesAgain {
        /// Its number.
        loader: u32,
        /// The batch that was due.
        n: u64,
        /// How often.
        times: u32,
        /// How it ended.
        status: ExitStatus,
    },
    /// Two loaders describe different data.
    #[error("loader {loader} reads other data than loader 0: expected stream {expected}, got {got}")]
    Differs {
        /// Its number.
        loader: u32,
        /// Stream hash of loader 0.
        expected: String,
        /// Its stream hash.
        got: String,
    },
    /// Ctrl-C before the loaders had connected.
    #[error("interrupted while loaders start")]
    Interrupted,
}

/// The loaders of a run; the product's [`BatchSource`].
///
/// Dropping it ends the processes and removes what was shared.
#[derive(Debug)]
pub struct Loaders {
    // Dropped in this order: the ways, the processes, the right to the name.
    subscribers: Vec<Option<Subscriber>>,
    children: Vec<Option<Running>>,
    claim: Claim,
    options: LoaderOptions,
    interrupt: Interrupt,
    hello: Option<Hello>,
    restarts: Vec<u32>,
}

/// A child that does not outlive its owner.
#[derive(Debug)]
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself; what counts is that it is gone and no zombie stays.
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

impl Loaders {
    /// Takes the name, starts the loaders for batches from `start` on and waits until all have introduced themselves.
    ///
    /// # Errors
    ///
    /// - [`LoaderError`] if the name is taken, a loader does not start, or one describes other data.
    pub fn start(options: LoaderOptions, start: u64, interrupt: &Interrupt) -> Result<Loaders, LoaderError> {
        let deadline = Instant::now() + options.patience;
        // Loaders of a killed trainer need a moment to notice; another living trainer is an error at once after that.
        let claim_deadline = Instant::now() + options.patience.min(Duration::from_secs(10));
        let claim = Claim::take(&Place::of_user(), &options.service, claim_deadline)?;
        let count = options.loaders as usize;
        let mut loaders = Loaders {
            subscribers: (0..count).map(|_| None).collect(),
            children: (0..count).map(|_| None).collect(),
            claim,
            options,
            interrupt: interrupt.clone(),
            hello: None,
            restarts: vec![0; count],
        };
        for loader in 0..loaders.options.loaders {
            if loaders.interrupt.is_set() {
                return Err(LoaderError::Interrupted);
            }
            loaders.launch(loader, start)?;
        }
        for loader in 0..loaders.options.loaders {
            loaders.greet(loader, start, deadline)?;
        }
        Ok(loaders)
    }

    /// What the loaders say about the data.
    pub fn hello(&self) -> &Hello {
        self.hello.as_ref().expect("`start` returns after every loader has said hello")
    }

    /// Opens our side of a loader and starts it, for batches from `n` on.
    fn launch(&mut self, loader: u32, n: u64) -> Result<(), LoaderError> {
        let (index, deadline) = (loader as usize, Instant::now() + self.options.patience);
        // The old side and the old process must be gone before the new ones come.
        self.subscribers[index] = None;
        self.children[index] = None;
        let loaders = self.options.loaders;
        let subscriber = self.claim.subscribe(loader, loaders, deadline)?;
        if let Some(command) = &self.options.command {
            let mut command = command.of(&self.options.service, loader, loaders, n);
            // Without it a loader that outlives this trainer before it has connected could attach to the next one.
            command.args(["--token", subscriber.token()]);
            let program = command.get_program().into();
            let child = command.spawn().map_err(|cause| LoaderError::Start { loader, program, cause })?;
            (self.options.say)(&format!("loader {loader} started at batch {n} (process {})", child.id()));
            self.children[index] = Some(Running(child));
        }
        self.subscribers[index] = Some(subscriber);
        Ok(())
    }

    /// Waits for the introduction of a loader and compares it with that of the first.
    fn greet(&mut self, loader: u32, n: u64, deadline: Instant) -> Result<(), LoaderError> {
        loop {
            let slice = deadline.min(Instant::now() + LOOK_PERIOD);
            let subscriber = self.subscribers[loader as usize].as_mut().expect("launched before");
            match subscriber.hello(slice) {
                Ok(hello) => {
                    let hello = hello.clone();
                    return self.compare(loader, hello);
                }
                Err(ShmError::Timeout { .. }) if Instant::now() < deadline => {}
                Err(error) => return Err(error.into()),
            }
            if self.interrupt.is_set() {
                return Err(LoaderError::Interrupted);
            }
            self.revive(loader, n)?;
        }
    }

    fn compare(&mut self, loader: u32, hello: Hello) -> Result<(), LoaderError> {
        match &self.hello {
            None => self.hello = Some(hello),
            Some(first) => {
                let (expected, got) = (first.stream_hash(), hello.stream_hash());
                if expected != got {
                    let (expected, got) = (expected.to_string(), got.to_string());
                    return Err(LoaderError::Differs { loader, expected, got });
                }
            }
        }
        Ok(())
    }

    /// Starts a loader again that was killed; an end with an exit code is final.
    fn revive(&mut self, loader: u32, n: u64) -> Result<(), LoaderError> {
        let index = loader as usize;
        let Some(Running(child)) = &mut self.children[index] else { return Ok(()) };
        // A process whose state cannot be asked is taken as running; the deadline ends the wait.
        let Some(status) = child.try_wait().ok().flatten() else { return Ok(()) };
        if status.code().is_some() {
            return Err(LoaderError::Ended { loader, n, status });
        }
        self.restarts[index] += 1;
        let times = self.restarts[index];
        if times > MAX_RESTARTS {
            return Err(LoaderError::DiesAgain { loader, n, times, status });
        }
        (self.options.say)(&format!("loader {loader} ended ({status}); it starts again at batch {n}"));
        self.launch(loader, n)?;
        self.greet(loader, n, Instant::now() + self.options.patience)
    }

    /// Waits for batch `n`, reviving its loader when that is killed.
    fn receive(&mut self, n: u64) -> Result<Slot, SourceError> {
        let loader = u32::try_from(n % u64::from(self.options.loaders)).expect("below the number of loaders");
        let deadline = Instant::now() + self.options.patience;
        loop {
            let slice = deadline.min(Instant::now() + LOOK_PERIOD);
            let subscriber = self.subscribers[loader as usize].as_mut().expect("launched at the start");
            match subscriber.next(n, slice) {
                Ok(slot) => {
                    self.restarts[loader as usize] = 0;
                    return Ok(slot);
                }
                Err(ShmError::Timeout { .. }) if Instant::now() < deadline => {}
                Err(ShmError::LoaderGone { .. }) if self.options.command.is_none() => {
                    self.await_new(loader, n)?
                }
                // Gone, but not reaped yet: the next look sees its status.
                Err(ShmError::LoaderGone { .. }) if Instant::now() < deadline => std::thread::yield_now(),
                Err(error) => return Err(LoaderError::from(error).into()),
            }
            if self.interrupt.is_set() {
                return Err(SourceError::Interrupted { n });
            }
            self.revive(loader, n)?;
        }
    }

    /// Opens our side again for a loader that somebody else starts.
    fn await_new(&mut self, loader: u32, n: u64) -> Result<(), LoaderError> {
        (self.options.say)(&format!(
            "loader {loader} is gone; waiting for `gawm-loader run ... --service {} --loader {loader} --loaders {} \
             --start {n}`",
            self.options.service, self.options.loaders
        ));
        self.launch(loader, n)?;
        self.greet(loader, n, Instant::now() + self.options.patience)
    }
}

impl BatchSource for Loaders {
    type Slot = Slot;

    fn next(&mut self, n: u64) -> Result<Slot, SourceError> {
        self.receive(n)
    }
}
