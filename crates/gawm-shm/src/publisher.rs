//! The loader's side.

use std::ops::{Deref, DerefMut};
use std::time::{Duration, Instant};

use gawm_schema::batch::{BatchLayout, Hello, SlotHeader};
use iceoryx2::node::Node;
use iceoryx2::port::LoanError;
use iceoryx2::port::publisher::Publisher as IpcPublisher;
use iceoryx2::prelude::BackpressureStrategy;
use iceoryx2::sample_mut_uninit::SampleMutUninit;

use crate::chunk::{self, Chunk};
use crate::domain::{Domain, Ipc};
use crate::error::ShmError;
use crate::lock::{self, Lock};
use crate::place::{Place, ServicePlace};
use crate::subscriber::{Channel, MAX_SLOTS, channel_name};
use crate::wait::Wait;
use crate::{greeting, room};

/// Time between two looks whether the trainer lives, while waiting for a credit.
const LIVENESS_PERIOD: Duration = Duration::from_millis(100);
/// Step in which slots are touched: the smallest page.
const PAGE_BYTES: usize = 4096;

type Loan = SampleMutUninit<Ipc, [std::mem::MaybeUninit<Chunk>], ()>;

/// How a loader connects.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PublisherOptions {
    /// The number of this loader.
    pub loader: u32,
    /// The number of loaders.
    pub loaders: u32,
    /// Batches that may be unconsumed at a time, the one being made included; 1 to
    /// [`MAX_SLOTS`].
    pub slots: usize,
    /// [`Subscriber::token`](crate::Subscriber::token) of the trainer that started this loader; `None` for a loader that was
    /// started by hand, which takes any trainer of the name.
    pub token: Option<String>,
}

/// Sends the batches of one loader.
#[derive(Debug)]
pub struct Publisher {
    parts: Option<Parts>,
    lock: Option<Lock>,
    service: ServicePlace,
    domain: Domain,
    token: String,
    options: PublisherOptions,
    layout: BatchLayout,
    last_look: Instant,
}

/// What is of iceoryx2, dropped in this order.
#[derive(Debug)]
struct Parts {
    port: IpcPublisher<Ipc, [Chunk], ()>,
    _channel: Channel,
    _node: Node<Ipc>,
}

impl Publisher {
    /// Waits until the trainer has opened its side, takes the room for all slots and says hello.
    ///
    /// # Errors
    /// - [`ShmError::NoTrainer`] if there is none by the deadline
    /// - [`ShmError::TrainerGone`] if the one with the token in `options` is gone or has given this loader up
    /// - [`ShmError::LoaderInUse`] if another loader of this number is alive
    /// - [`ShmError::NoRoom`] if the slots do not fit into shared memory
    /// - [`ShmError::Slots`] if there are none or more than [`MAX_SLOTS`]
    /// - [`ShmError::Batch`] if the shape in the hello cannot be laid out
    /// - [`ShmError::BadName`], [`ShmError::Transport`], [`ShmError::Io`]
    pub fn connect(
        place: &Place,
        name: &str,
        hello: &Hello,
        options: PublisherOptions,
        deadline: Instant,
    ) -> Result<Publisher, ShmError> {
        let PublisherOptions { loader, slots, .. } = options;
        let wanted = options.token.as_deref();
        if !(1..=MAX_SLOTS).contains(&slots) {
            return Err(ShmError::Slots { got: slots });
        }
        let service = place.service(name)?;
        let layout = hello.layout().map_err(|source| ShmError::Batch { loader, source })?;
        let json = hello.to_json();
        let slot_bytes = layout.total_bytes().max(greeting::length(&json));
        room::check(slots, slot_bytes)?;
        let domain = service.domain(loader);
        let (lock, token) = attach(&service, &domain, wanted, deadline)?;
        let node = domain.node()?;
        let parts = open(&domain, node, &token, slots, slot_bytes)?;
        room::reserve(&domain, slots, slot_bytes)?;
        let mut publisher = Publisher {
            parts: Some(parts),
            lock: Some(lock),
            service,
            domain,
            token,
            options,
            layout,
            last_look: Instant::now(),
        };
        publisher.prefault(slot_bytes, deadline)?;
        let mut slot = publisher.loan_bytes(greeting::length(&json), deadline)?;
        greeting::write(&json, &mut slot);
        publisher.send(slot)?;
        Ok(publisher)
    }

    /// Returns the layout of the slots.
    pub fn layout(&self) -> &BatchLayout {
        &self.layout
    }

    /// Waits for a credit and returns a slot; its bytes are what an earlier batch left.
    ///
    /// # Errors
    /// - [`ShmError::TrainerGone`] if the trainer has ended or given this loader up
    /// - [`ShmError::Timeout`] if no slot is free by the deadline
    /// - [`ShmError::Transport`]
    pub fn loan(&mut self, deadline: Instant) -> Result<SlotMut, ShmError> {
        self.loan_bytes(self.layout.total_bytes(), deadline)
    }

    /// Writes the header into a filled slot and sends it.
    ///
    /// # Errors
    /// - [`ShmError::TrainerGone`] if nobody receives it
    /// - [`ShmError::Transport`]
    pub fn publish(&mut self, mut slot: SlotMut, header: &SlotHeader) -> Result<(), ShmError> {
        header.write(&self.layout, &mut slot);
        self.send(slot)
    }

    /// Returns whether the trainer lives and still wants this loader; cheap enough to ask once per clip.
    pub fn is_wanted(&mut self) -> bool {
        if self.last_look.elapsed() < LIVENESS_PERIOD {
            return true;
        }
        self.last_look = Instant::now();
        self.service.is_trainer_alive() && self.domain.read_ready().as_ref() == Some(&self.token)
    }

    /// Waits until the trainer has given every slot back, so that nothing it has not read ends with this process.
    ///
    /// # Errors
    /// - [`ShmError::TrainerGone`]
    /// - [`ShmError::Timeout`] if slots are still out at the deadline
    pub fn drain(&mut self, deadline: Instant) -> Result<(), ShmError> {
        let mut slots = Vec::with_capacity(self.options.slots);
        for _ in 0..self.options.slots {
            slots.push(self.loan(deadline)?);
        }
        Ok(())
    }

    /// Returns how many slots are free now: the credits.
    ///
    /// # Errors
    /// [`ShmError::Transport`]
    pub fn credits(&mut self) -> Result<usize, ShmError> {
        let mut slots = Vec::with_capacity(self.options.slots);
        while slots.len() < self.options.slots {
            match self.try_loan(self.layout.total_bytes())? {
                Some(slot) => slots.push(slot),
                None => break,
            }
        }
        Ok(slots.len())
    }

    fn loan_bytes(&mut self, bytes: usize, deadline: Instant) -> Result<SlotMut, ShmError> {
        let mut wait = Wait::until(deadline);
        loop {
            if let Some(slot) = self.try_loan(bytes)? {
                return Ok(slot);
            }
            if !self.is_wanted() {
                return Err(self.gone());
            }
            if !wait.again() {
                return Err(ShmError::Timeout { what: "free slot", waited: wait.waited() });
            }
        }
    }

    fn try_loan(&self, bytes: usize) -> Result<Option<SlotMut>, ShmError> {
        match self.parts().port.loan_slice_uninit(chunk::chunks_of(bytes)) {
            Ok(loan) => Ok(Some(SlotMut { loan })),
            Err(LoanError::OutOfMemory | LoanError::ExceedsMaxLoans) => Ok(None),
            Err(error) => Err(ShmError::transport(&self.domain.service, "loan a slot")(&error)),
        }
    }

    /// Touches every page of every slot, so that the first batches do not pay for it.
    fn prefault(&mut self, slot_bytes: usize, deadline: Instant) -> Result<(), ShmError> {
        let mut slots = Vec::with_capacity(self.options.slots);
        for _ in 0..self.options.slots {
            let mut slot = self.loan_bytes(slot_bytes, deadline)?;
            slot.iter_mut().step_by(PAGE_BYTES).for_each(|byte| *byte = 0);
            slots.push(slot);
        }
        Ok(())
    }

    pub(crate) fn send(&mut self, slot: SlotMut) -> Result<(), ShmError> {
        let receivers = slot.send();
        match receivers.map_err(|e| ShmError::transport(&self.domain.service, "send a slot")(&e))? {
            0 => Err(self.gone()),
            _ => Ok(()),
        }
    }

    fn gone(&self) -> ShmError {
        ShmError::TrainerGone { name: self.domain.service.clone() }
    }

    fn parts(&self) -> &Parts {
        self.parts.as_ref().expect("taken only when dropped")
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        let is_wanted =
            self.service.is_trainer_alive() && self.domain.read_ready().as_ref() == Some(&self.token);
        drop(self.parts.take());
        if !is_wanted {
            // This process is the last of the pair. What it cannot remove, the next start or `clean` does.
            self.domain.sweep().ok();
        }
        drop(self.lock.take());
    }
}

/// A slot that is being filled; dropped without publishing, its credit is kept.
pub struct SlotMut {
    loan: Loan,
}

impl Deref for SlotMut {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        chunk::loaned_bytes(self.loan.payload())
    }
}

impl DerefMut for SlotMut {
    fn deref_mut(&mut self) -> &mut [u8] {
        chunk::loaned_bytes_mut(self.loan.payload_mut())
    }
}

impl SlotMut {
    fn send(self) -> Result<usize, iceoryx2::port::SendError> {
        chunk::assume_filled(self.loan).send()
    }
}

/// Takes the loader's lock at a moment when the trainer's side is open.
///
/// A trainer opens its side before it starts a loader. So a loader that knows its trainer's token need not wait for it, and
/// must not: one whose trainer was killed meanwhile would attach to the next trainer with a place in the run that is not
/// the next one's.
fn attach(
    service: &ServicePlace,
    domain: &Domain,
    wanted: Option<&str>,
    deadline: Instant,
) -> Result<(Lock, String), ShmError> {
    let mut wait = Wait::until(deadline);
    loop {
        service.create()?;
        let lock = Lock::try_take(&domain.lock_path())?;
        let is_free = lock.is_some();
        let open = domain.read_ready().filter(|_| service.is_trainer_alive());
        if let Some(wanted) = wanted
            && open.as_deref() != Some(wanted)
        {
            return Err(ShmError::TrainerGone { name: service.name.clone() });
        }
        if let (Some(lock), Some(token)) = (lock, open) {
            return Ok((lock, token));
        }
        if !wait.again() {
            let (name, waited) = (service.name.clone(), wait.waited());
            if is_free {
                return Err(ShmError::NoTrainer { name, waited });
            }
            let process = lock::holder(&domain.lock_path());
            return Err(ShmError::LoaderInUse { name, loader: domain.loader, process });
        }
    }
}

fn open(
    domain: &Domain,
    node: Node<Ipc>,
    token: &str,
    slots: usize,
    slot_bytes: usize,
) -> Result<Parts, ShmError> {
    let name = channel_name(&domain.service, token)?;
    let refused = |operation| ShmError::transport(&domain.service, operation);
    let builder = node.service_builder(&name).publish_subscribe::<[Chunk]>();
    let channel = builder
        .max_publishers(1)
        .max_subscribers(1)
        .max_nodes(2)
        .history_size(0)
        .enable_safe_overflow(false)
        .subscriber_max_buffer_size(MAX_SLOTS)
        .subscriber_max_borrowed_samples(MAX_SLOTS)
        .open();
    let channel = channel.map_err(|e| refused("open the service")(&e))?;
    let port = channel
        .publisher_builder()
        .max_loaned_samples(slots)
        .initial_max_slice_len(chunk::chunks_of(slot_bytes))
        // As many as there are credits: sending can then never find a full queue.
        .override_sample_preallocation(move |_| slots)
        .backpressure_strategy(BackpressureStrategy::DiscardData)
        .create();
    let port = port.map_err(|e| refused("create the slots")(&e))?;
    Ok(Parts { port, _channel: channel, _node: node })
}
