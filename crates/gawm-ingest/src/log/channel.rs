//! Channels and schemas, and which definition of an id is in force where.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;

use super::damage::{Damage, DamageKind};
use super::wire::{ChannelRecord, SchemaRecord};

/// The schema of a channel's messages.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Schema {
    /// Id within the file, never 0.
    pub id: u16,
    /// Name of the message type.
    pub name: String,
    /// Encoding of `data`, such as `ros2msg`, `protobuf`, `jsonschema`; may be empty.
    pub encoding: String,
    /// Text or bytes of the schema.
    pub data: Bytes,
}

/// A channel: one topic, one message encoding, one schema.
///
/// Two channels are equal when their definitions are, so that a plan can be kept per definition
/// even where a damaged file gives one id two of them.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Channel {
    /// Id within the file.
    pub id: u16,
    /// Topic; several channels may share one.
    pub topic: String,
    /// Encoding of the messages, such as `cdr`, `json`, `protobuf`; says nothing about the schema's.
    pub message_encoding: String,
    /// Key-value pairs of the writer, such as `offered_qos_profiles`.
    pub metadata: BTreeMap<String, String>,
    /// Id of the schema as the record states it; 0 means none.
    pub schema_id: u16,
    /// The schema, `None` when `schema_id` is 0 or that schema is defined nowhere.
    pub schema: Option<Arc<Schema>>,
}

/// A definition as it was found in the file.
#[derive(Debug, Clone)]
pub(crate) enum Definition {
    Schema(Schema),
    Channel(ChannelRecord),
}

impl Definition {
    pub(crate) fn schema(record: &SchemaRecord<'_>) -> Self {
        Self::Schema(schema_of(record))
    }
}

pub(crate) fn schema_of(record: &SchemaRecord<'_>) -> Schema {
    Schema {
        id: record.id,
        name: record.name.clone(),
        encoding: record.encoding.clone(),
        data: Bytes::copy_from_slice(record.data),
    }
}

/// Every definition of every id with the offset from which it is in force.
#[derive(Debug, Default)]
pub(crate) struct ChannelTable {
    schemas: BTreeMap<u16, Vec<(u64, Arc<Schema>)>>,
    records: BTreeMap<u16, Vec<(u64, ChannelRecord)>>,
    channels: BTreeMap<u16, Vec<(u64, Arc<Channel>)>>,
}

impl ChannelTable {
    /// Takes a definition found at `offset` of the data section; definitions must come in file order.
    pub(crate) fn define(&mut self, offset: u64, definition: Definition, damage: &mut Vec<Damage>) {
        match definition {
            Definition::Schema(schema) if schema.id == 0 => damage.push(Damage::new(
                DamageKind::RecordMalformed,
                offset,
                format!("schema {:?} has the reserved id 0; it is ignored", schema.name),
            )),
            Definition::Schema(schema) => {
                let versions = self.schemas.entry(schema.id).or_default();
                match versions.last() {
                    Some((_, last)) if **last == schema => return,
                    Some((_, last)) => damage.push(Damage::new(
                        DamageKind::SchemaRedefined,
                        offset,
                        format!(
                            "schema {} was {:?}, is {:?} with other content from here on",
                            schema.id, last.name, schema.name
                        ),
                    )),
                    None => {}
                }
                versions.push((offset, Arc::new(schema)));
            }
            Definition::Channel(record) => {
                let versions = self.records.entry(record.id).or_default();
                match versions.last() {
                    Some((_, last)) if *last == record => return,
                    Some((_, last)) => damage.push(Damage::new(
                        DamageKind::ChannelRedefined,
                        offset,
                        format!(
                            "channel {} was {:?}, is {:?} with other content from here on",
                            record.id, last.topic, record.topic
                        ),
                    )),
                    None => {}
                }
                versions.push((offset, record));
            }
        }
    }

    /// Takes a definition only where its id has none yet; returns whether it was taken.
    pub(crate) fn define_if_new(&mut self, definition: Definition) -> bool {
        match definition {
            Definition::Schema(schema) if schema.id == 0 || self.schemas.contains_key(&schema.id) => false,
            Definition::Schema(schema) => {
                self.schemas.insert(schema.id, vec![(0, Arc::new(schema))]);
                true
            }
            Definition::Channel(record) if self.records.contains_key(&record.id) => false,
            Definition::Channel(record) => {
                self.records.insert(record.id, vec![(0, record)]);
                true
            }
        }
    }

    /// Binds channels to schemas; call once when all definitions are in.
    pub(crate) fn bind(&mut self, damage: &mut Vec<Damage>) {
        self.channels.clear();
        for (&id, versions) in &self.records {
            let mut bound = Vec::with_capacity(versions.len());
            for (offset, record) in versions {
                let schema = self.schema_at(record.schema_id, *offset);
                if schema.is_none() && record.schema_id != 0 {
                    damage.push(Damage::new(
                        DamageKind::UnknownSchema,
                        *offset,
                        format!(
                            "channel {id} {:?} refers to schema {}, which is defined nowhere",
                            record.topic, record.schema_id
                        ),
                    ));
                }
                bound.push((*offset, Arc::new(channel_of(record, schema.cloned()))));
            }
            self.channels.insert(id, bound);
        }
    }

    /// Returns the largest channel id plus one.
    pub(crate) fn id_limit(&self) -> usize {
        self.channels.last_key_value().map_or(0, |(&id, _)| usize::from(id) + 1)
    }

    /// Returns the schema in force for what starts at `offset`.
    pub(crate) fn schema_at(&self, id: u16, offset: u64) -> Option<&Arc<Schema>> {
        version_at(self.schemas.get(&id)?, offset)
    }

    /// Returns the channel in force for what starts at `offset`.
    pub(crate) fn channel_at(&self, id: u16, offset: u64) -> Option<&Arc<Channel>> {
        version_at(self.channels.get(&id)?, offset)
    }

    /// Returns the equal channel of the table, if there is one.
    pub(crate) fn find(&self, channel: &Channel) -> Option<&Arc<Channel>> {
        self.channels.get(&channel.id)?.iter().map(|(_, known)| known).find(|known| ***known == *channel)
    }

    /// Returns whether an equal schema is in the table.
    pub(crate) fn has_schema(&self, schema: &Schema) -> bool {
        self.schemas
            .get(&schema.id)
            .is_some_and(|versions| versions.iter().any(|(_, known)| **known == *schema))
    }

    /// Returns the first definition of every id.
    pub(crate) fn first_definitions(&self) -> BTreeMap<u16, Arc<Channel>> {
        let first = |versions: &Vec<(u64, Arc<Channel>)>| versions.first().map(|(_, c)| Arc::clone(c));
        self.channels.iter().filter_map(|(&id, versions)| Some((id, first(versions)?))).collect()
    }
}

/// Joins a channel record and its schema.
pub(crate) fn channel_of(record: &ChannelRecord, schema: Option<Arc<Schema>>) -> Channel {
    Channel {
        id: record.id,
        topic: record.topic.clone(),
        message_encoding: record.message_encoding.clone(),
        metadata: record.metadata.clone(),
        schema_id: record.schema_id,
        schema,
    }
}

/// The last version from before or at `offset`; the first one for what lies before all of them.
fn version_at<T>(versions: &[(u64, T)], offset: u64) -> Option<&T> {
    let n_before = versions.partition_point(|(from, _)| *from <= offset);
    versions.get(n_before.saturating_sub(1)).map(|(_, value)| value)
}
