//! Samples clips from datasets and decodes them straight into shared-memory slots.

