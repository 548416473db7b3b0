//! What inspection asks of the decoders.

use std::cell::RefCell;

use crate::decode::{ChannelSchema, DecodePlan, Decoded, RowSink, SchemaLibrary, channel_fields};
use crate::log::Channel;

/// Reads the header stamp of a payload in nanoseconds.
pub type StampReader = Box<dyn Fn(&[u8]) -> Option<i64> + Send + Sync>;

/// What the decoders know of one channel.
#[derive(Default)]
pub struct ChannelProbe {
    /// Why its messages cannot be decoded; `None` when they can.
    pub obstacle: Option<String>,
    /// Reads the header stamp of its messages, where they have one.
    pub stamp: Option<StampReader>,
}

/// Tells which channels can be decoded, and reads header stamps.
pub trait MessageProbe: Sync {
    /// Looks at one channel; called once for each definition.
    fn probe(&self, channel: &Channel) -> ChannelProbe;
}

/// Asks the decoders, with the message types that they are given.
#[derive(Debug, Clone, Default)]
pub struct DecoderProbe {
    /// Types for channels without a schema.
    pub library: SchemaLibrary,
}

thread_local! {
    /// Stamps are read one message at a time; the sink keeps its memory between them.
    static SINK: RefCell<RowSink> = RefCell::new(RowSink::new());
}

impl MessageProbe for DecoderProbe {
    fn probe(&self, channel: &Channel) -> ChannelProbe {
        let schema = channel.schema.as_deref();
        let about = ChannelSchema {
            topic: &channel.topic,
            message_encoding: &channel.message_encoding,
            schema_name: schema.map_or("", |schema| &schema.name),
            schema_encoding: schema.map_or("", |schema| &schema.encoding),
            schema_data: schema.map_or(&[], |schema| &schema.data),
        };
        if let Err(error) = channel_fields(&about, &self.library) {
            return ChannelProbe { obstacle: Some(error.to_string()), stamp: None };
        }
        let plan = DecodePlan::compile(&about, &[], &self.library).ok().filter(DecodePlan::has_stamp);
        ChannelProbe { obstacle: None, stamp: plan.map(stamp_reader) }
    }
}

fn stamp_reader(plan: DecodePlan) -> StampReader {
    Box::new(move |payload| {
        SINK.with_borrow_mut(|sink| {
            sink.clear();
            match plan.decode(payload, sink) {
                Ok(Decoded::Row { stamp_ns }) => stamp_ns,
                _ => None,
            }
        })
    })
}
