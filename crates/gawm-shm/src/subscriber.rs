//! The trainer's side of one loader.

use std::fmt;
use std::ops::Deref;
use std::time::Instant;

use gawm_schema::batch::{BatchError, BatchLayout, BatchView, Hello, SlotHeader};
use iceoryx2::node::Node;
use iceoryx2::port::subscriber::Subscriber as IpcSubscriber;
use iceoryx2::prelude::ServiceName;
use iceoryx2::sample::Sample;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use crate::chunk::{self, Chunk};
use crate::domain::{Domain, Ipc};
use crate::error::ShmError;
use crate::greeting;
use crate::wait::Wait;

/// Most slots that a loader may have.
///
/// A place in a queue is a few bytes, so the trainer always has room for so many and need not know how many there are.
pub const MAX_SLOTS: usize = 16;

/// The iceoryx2 service of one loader.
pub(crate) type Channel = PortFactory<Ipc, [Chunk], ()>;

/// Receives the batches of one loader, in order.
///
/// ```no_run
/// # use std::time::{Duration, Instant};
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let in_10_s = || Instant::now() + Duration::from_secs(10);
/// let claim = gawm_shm::Claim::take(&gawm_shm::Place::of_user(), "run-1", in_10_s())?;
/// let mut subscriber = claim.subscribe(0, 1, in_10_s())?;
/// let token = subscriber.token().to_owned();
/// // ... start the loader: gawm-loader run --service run-1 --token TOKEN --loader 0 --loaders 1 --start 0 ...
/// let hello = subscriber.hello(in_10_s())?.clone();
/// for n in 0..hello.sequence.batches() {
///     let slot = subscriber.next(n, in_10_s())?;
///     let view = slot.view()?; // frames, actions, states, masks: slices of shared memory
///     println!("{:?}: {} clips", view.header().batch, view.shape().clips);
/// } // the slot is dropped: its credit goes back to the loader
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Subscriber {
    // Dropped in this order: port, service, node.
    port: IpcSubscriber<Ipc, [Chunk], ()>,
    _channel: Channel,
    _node: Node<Ipc>,
    domain: Domain,
    token: String,
    loaders: u32,
    hello: Option<Greeted>,
}

#[derive(Debug)]
struct Greeted {
    hello: Hello,
    layout: BatchLayout,
    stream_hash: gawm_schema::ContentHash,
}

impl Subscriber {
    pub(crate) fn open(domain: Domain, token: String, loaders: u32) -> Result<Subscriber, ShmError> {
        let node = domain.node()?;
        let channel = create_channel(&node, &domain.service, &token)?;
        let port = channel.subscriber_builder().buffer_size(MAX_SLOTS).create();
        let port = port.map_err(|e| ShmError::transport(&domain.service, "subscribe")(&e))?;
        Ok(Subscriber { port, _channel: channel, _node: node, domain, token, loaders, hello: None })
    }

    /// Returns the number of the loader.
    pub fn loader(&self) -> u32 {
        self.domain.loader
    }

    /// Returns what identifies this subscriber among all of the name, ever.
    ///
    /// A trainer gives it to the loader that it starts (`gawm-loader run --token`). Without it a loader whose trainer is
    /// killed before it has connected could attach to the next trainer, which is at another place of the run.
    pub fn token(&self) -> &str {
        &self.token
    }

    /// Waits for the loader's introduction; later calls return it at once.
    ///
    /// # Errors
    /// - [`ShmError::Timeout`] if the loader has not connected by the deadline
    /// - [`ShmError::Foreign`], [`ShmError::Hello`] if it is of another version or says what cannot be
    /// - [`ShmError::Transport`]
    pub fn hello(&mut self, deadline: Instant) -> Result<&Hello, ShmError> {
        if self.hello.is_none() {
            let sample = self.receive("hello message of a loader", deadline, false)?;
            let loader = self.loader();
            let hello = greeting::read(loader, chunk::bytes(sample.payload()))?;
            let layout = hello.layout().map_err(|source| ShmError::Batch { loader, source })?;
            let stream_hash = hello.stream_hash();
            self.hello = Some(Greeted { hello, layout, stream_hash });
        }
        let greeted = self.hello.as_ref();
        Ok(&greeted.expect("it was set just above").hello)
    }

    /// Waits for the n-th batch of the run, which must be one of this loader's.
    ///
    /// A batch that is queued is taken without waiting. Nothing is copied but the header.
    ///
    /// # Errors
    /// - [`ShmError::LoaderGone`] if the loader has ended and nothing is queued
    /// - [`ShmError::Timeout`] if it lives but has nothing by the deadline
    /// - [`ShmError::Batch`] if the slot is stale, torn, foreign or of another layout
    /// - [`ShmError::Sequence`] if it is another batch than the n-th, or made from other data
    /// - errors of [`Subscriber::hello`] if there was none yet
    pub fn next(&mut self, n: u64, deadline: Instant) -> Result<Slot, ShmError> {
        self.hello(deadline)?;
        let sample = self.receive("batch", deadline, true)?;
        let loader = self.loader();
        let greeted = self.hello.as_ref().expect("the call of hello() above has set it");
        let bytes = chunk::bytes(sample.payload());
        let view = BatchView::try_new(&greeted.layout, bytes);
        let header = *view.map_err(|source| ShmError::Batch { loader, source })?.header();
        self.check(n, &header)?;
        Ok(Slot { sample, layout: greeted.layout, header })
    }

    /// Returns whether a message is queued: the next wait is then none.
    ///
    /// # Errors
    /// [`ShmError::Transport`]
    pub fn is_queued(&self) -> Result<bool, ShmError> {
        let queued = self.port.has_samples();
        queued.map_err(|e| ShmError::transport(&self.domain.service, "ask for slots")(&e))
    }

    /// Returns whether the loader's process is alive.
    pub fn is_loader_alive(&self) -> bool {
        self.domain.is_loader_alive()
    }

    /// Checks that a batch is the one that is due; texts are made for messages only, since this runs for every batch.
    fn check(&self, n: u64, header: &SlotHeader) -> Result<(), ShmError> {
        let Greeted { hello, stream_hash, .. } = self.hello.as_ref().expect("checked after the hello");
        let loader = self.loader();
        let wrong = |field, expected: &dyn fmt::Display, got: &dyn fmt::Display| {
            Err(ShmError::Sequence { loader, field, expected: expected.to_string(), got: got.to_string() })
        };
        if header.schema_hash != hello.schema_hash {
            return wrong("schema hash", &hello.schema_hash, &header.schema_hash);
        }
        if header.stream_hash != *stream_hash {
            return wrong("stream hash", stream_hash, &header.stream_hash);
        }
        if header.n != n {
            return wrong("position", &n, &header.n);
        }
        let batch = hello.sequence.batch(n);
        if batch != Some(header.batch) {
            return wrong("batch", &format!("{batch:?}"), &format!("{:?}", header.batch));
        }
        if (header.loader, header.loaders) != (loader, self.loaders) {
            let got = format!("{} of {}", header.loader, header.loaders);
            return wrong("loader", &format!("{loader} of {}", self.loaders), &got);
        }
        if header.ranks != hello.ranks {
            return wrong("number of ranks", &hello.ranks, &header.ranks);
        }
        Ok(())
    }

    fn receive(
        &self,
        what: &'static str,
        deadline: Instant,
        is_greeted: bool,
    ) -> Result<Sample<Ipc, [Chunk], ()>, ShmError> {
        let mut wait = Wait::until(deadline);
        loop {
            // Asked before looking: what a loader sent before its end is then seen below.
            let is_gone = is_greeted && wait.is_slow() && !self.is_loader_alive();
            let received = self.port.receive();
            let received = received.map_err(|e| ShmError::transport(&self.domain.service, "receive")(&e))?;
            if let Some(sample) = received {
                return Ok(sample);
            }
            if is_gone {
                return Err(ShmError::LoaderGone {
                    name: self.domain.service.clone(),
                    loader: self.loader(),
                });
            }
            if !wait.again() {
                return Err(ShmError::Timeout { what, waited: wait.waited() });
            }
        }
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        // A loader that sees it leaves; if it cannot be removed, the loader waits until the claim is gone.
        self.domain.remove_ready().ok();
    }
}

/// A batch in shared memory; dropping it gives the slot back to its loader.
#[derive(Debug)]
pub struct Slot {
    sample: Sample<Ipc, [Chunk], ()>,
    layout: BatchLayout,
    header: SlotHeader,
}

impl Slot {
    /// Returns the header, as it was when the slot was received.
    pub fn header(&self) -> &SlotHeader {
        &self.header
    }

    /// Views the arrays of the batch.
    ///
    /// # Errors
    /// [`BatchError`] if the header has been overwritten since the slot was received.
    pub fn view(&self) -> Result<BatchView<'_>, BatchError> {
        BatchView::try_new(&self.layout, self)
    }
}

impl Deref for Slot {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        chunk::bytes(self.sample.payload())
    }
}

/// Creates the service as the trainer.
fn create_channel(node: &Node<Ipc>, service: &str, token: &str) -> Result<Channel, ShmError> {
    let name = channel_name(service, token)?;
    // One queued and one borrowed place per slot: a subscriber can have them all either way.
    let builder = node.service_builder(&name).publish_subscribe::<[Chunk]>();
    let created = builder
        .max_publishers(1)
        .max_subscribers(1)
        .max_nodes(2)
        .history_size(0)
        .enable_safe_overflow(false)
        .subscriber_max_buffer_size(MAX_SLOTS)
        .subscriber_max_borrowed_samples(MAX_SLOTS)
        .create();
    created.map_err(|e| ShmError::transport(service, "create the service")(&e))
}

pub(crate) fn channel_name(service: &str, token: &str) -> Result<ServiceName, ShmError> {
    let name = format!("gawm/slots/{token}");
    ServiceName::new(&name).map_err(|e| ShmError::transport(service, "name the service")(&e))
}
