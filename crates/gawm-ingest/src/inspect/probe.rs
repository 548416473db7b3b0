//! What inspection asks of the decoders.

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

/// A probe that goes by the encodings' names alone and reads no stamps.
#[derive(Debug, Clone, Copy, Default)]
pub struct EncodingProbe;

impl MessageProbe for EncodingProbe {
    fn probe(&self, channel: &Channel) -> ChannelProbe {
        let schema = channel.schema.as_deref().map_or("", |schema| schema.encoding.as_str());
        let is_known = matches!(
            (channel.message_encoding.as_str(), schema),
            ("cdr", "ros2msg") | ("ros1", "ros1msg") | ("protobuf", "protobuf") | ("json", _)
        );
        let obstacle = (!is_known).then(|| {
            format!(
                "no decoder for message encoding {:?} with schema encoding {schema:?}",
                channel.message_encoding
            )
        });
        ChannelProbe { obstacle, stamp: None }
    }
}
