//! Batches between processes in fixed-layout shared-memory slots (iceoryx2).
//!
//! A trainer takes a [`Claim`] on a service name and opens one [`Subscriber`] per loader. A loader connects a
//! [`Publisher`], which first says [`Hello`](gawm_schema::batch::Hello), then loans slots, fills their bytes and
//! publishes them. The trainer takes them in order as [`Slot`]s, whose bytes it views without a copy; dropping a slot
//! gives its credit back.
//!
//! ```text
//! trainer                                      loader k of K
//! Claim::take(place, name)                     Publisher::connect(place, name, k, &hello, slots)
//! claim.subscribe(k, K) ── token ────────────> │
//! subscriber.hello(deadline) <──── hello ───── │
//! subscriber.next(n, deadline) <── slot n ──── publisher.loan() ... publish()
//! drop(slot) ────────────────────  credit ───> │
//! ```
//!
//! Design decisions:
//!
//! - **Credits are memory.** A publisher owns as many slots as there are credits, and no more; the subscriber's queue has
//!   room for all of them. So sending never blocks and never drops, and a loader that is out of credit notices it when it
//!   loans. iceoryx2's blocking delivery, which hangs when the receiver is killed, is not used.
//! - **Who is alive is decided by file locks** (`flock`), which the kernel releases however a process ends: the trainer
//!   holds one for the name, each loader one for its number. Shared memory belongs to the pair (name, loader) by its
//!   file names, and whoever holds the locks of a pair of which the others are gone removes all of it. So nothing
//!   depends on what a killed process left half done, and nothing of it stays.
//! - **Waits are timed polls** (50 us growing to 1 ms), not a second event service: a wait then needs no other living
//!   process to end it, there is nothing further to clean up, and a batch that is queued is taken without waiting.
//!
//! **Invariant**: only this crate knows iceoryx2; every wait has a deadline; no content of a slot, a lock file or a ready
//! file makes it panic.
#![deny(unsafe_code)]

mod chunk;
mod claim;
mod domain;
mod error;
mod greeting;
mod lock;
mod mmap;
mod place;
mod publisher;
mod room;
mod subscriber;
mod wait;

pub use claim::Claim;
pub use error::ShmError;
pub use mmap::MappedFile;
pub use place::{CleanReport, Place};
pub use publisher::{Publisher, PublisherOptions, SlotMut};
pub use subscriber::{MAX_SLOTS, Slot, Subscriber};

#[cfg(test)]
mod tests;
