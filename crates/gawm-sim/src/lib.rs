//! Environments and log collection: native TwoRoom.
