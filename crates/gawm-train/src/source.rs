//! Where batches come from: a trait with one product, [`Loaders`](crate::loaders::Loaders).

use std::ops::Deref;

use gawm_schema::ContentHash;
use gawm_schema::batch::{BatchError, BatchLayout, BatchView, Hello, Sequence};
use thiserror::Error;

use crate::loaders::LoaderError;

/// Gives out the batches of a run in order.
///
/// The loop sees nothing else of the outside world, so that tests can hold batches in memory.
pub trait BatchSource {
    /// The bytes of a batch; dropping them gives the slot back.
    type Slot: Deref<Target = [u8]>;

    /// Waits for the n-th batch of the run. Calls come with n, n + 1, ...
    ///
    /// # Errors
    ///
    /// - [`SourceError`] if it will not come.
    fn next(&mut self, n: u64) -> Result<Self::Slot, SourceError>;
}

/// Why a batch does not come, or cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SourceError {
    /// Ctrl-C while waiting.
    #[error("interrupted while waiting for batch {n}")]
    Interrupted {
        /// Position in the sequence.
        n: u64,
    },
    /// The source has no such batch.
    #[error("no batch {n}: the source has ended")]
    Ended {
        /// Position in the sequence.
        n: u64,
    },
    /// A loader or the way to it failed.
    #[error(transparent)]
    Loader(#[from] LoaderError),
    /// The slot is not the batch that is expected.
    #[error("batch {n}: {cause}")]
    Batch {
        /// Position in the sequence.
        n: u64,
        /// The cause.
        cause: BatchError,
    },
    /// The slot holds another batch of the run, or one of another run.
    #[error("batch {n}: expected {field} {expected}, got {got}")]
    Foreign {
        /// Position in the sequence.
        n: u64,
        /// What differs.
        field: &'static str,
        /// What this run needs.
        expected: String,
        /// What the slot says.
        got: String,
    },
}

/// What the slots of a run must be.
#[derive(Debug, Clone)]
pub struct Expected {
    layout: BatchLayout,
    sequence: Sequence,
    schema_hash: ContentHash,
    stream_hash: ContentHash,
}

impl Expected {
    /// Takes from a hello what its slots must say.
    ///
    /// # Errors
    ///
    /// - [`BatchError::Shape`] if the shape of its batches cannot be laid out.
    pub fn of(hello: &Hello) -> Result<Expected, BatchError> {
        let (schema_hash, stream_hash) = (hello.schema_hash, hello.stream_hash());
        Ok(Expected { layout: hello.layout()?, sequence: hello.sequence, schema_hash, stream_hash })
    }

    /// Views the bytes of a slot as the n-th batch of the run.
    ///
    /// # Errors
    ///
    /// - [`SourceError::Batch`], [`SourceError::Foreign`] if it is anything else.
    pub fn view<'a>(&self, n: u64, slot: &'a [u8]) -> Result<BatchView<'a>, SourceError> {
        let view = BatchView::try_new(&self.layout, slot).map_err(|cause| SourceError::Batch { n, cause })?;
        let header = view.header();
        let foreign = |field, expected: String, got: String| SourceError::Foreign { n, field, expected, got };
        if header.n != n {
            return Err(foreign("position", n.to_string(), header.n.to_string()));
        }
        if header.schema_hash != self.schema_hash {
            return Err(foreign("schema hash", self.schema_hash.to_string(), header.schema_hash.to_string()));
        }
        if header.stream_hash != self.stream_hash {
            return Err(foreign("stream hash", self.stream_hash.to_string(), header.stream_hash.to_string()));
        }
        let expected = self.sequence.batch(n);
        if expected != Some(header.batch) {
            return Err(foreign("batch", format!("{expected:?}"), format!("{:?}", header.batch)));
        }
        Ok(view)
    }
}
