//! Protobuf payloads: a walker over the wire format that reads what a plan asks for and steps over the rest.

pub(crate) mod node;
pub(crate) mod run;
pub(crate) mod whole;
pub(crate) mod wire;
