//! Batches between processes in fixed-layout shared-memory slots (iceoryx2).

