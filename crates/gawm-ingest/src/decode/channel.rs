//! A channel as decoding sees it: encodings and schema, and the library for channels that carry none.

use std::path::Path;
use std::sync::Arc;

use prost_reflect::MessageDescriptor;

use super::error::CompileError;
use super::schema::ros_library::{Library, SchemaFolderError, describe};
use super::schema::ros_msg::{Dialect, Fault, library_type, parse_schema};
use super::schema::{TypeTable, json_schema, proto, ros_idl};
use super::transcode::Transcoder;
use super::transcode::flatbuffer::Reflection;

/// What decoding needs to know of a channel.
#[derive(Clone, Copy, Debug, Default)]
pub struct ChannelSchema<'a> {
    /// Topic, for errors.
    pub topic: &'a str,
    /// Message encoding of the channel: `cdr`, `ros1`, `protobuf`, `json`, `cbor`, `flatbuffer`.
    pub message_encoding: &'a str,
    /// Type name; empty without a schema. A contract may give it in place of the log.
    pub schema_name: &'a str,
    /// Schema encoding: `ros2msg`, `ros2idl`, `ros1msg`, `protobuf`, `jsonschema`, `flatbuffer`; empty without a schema.
    pub schema_encoding: &'a str,
    /// The schema's bytes; empty without a schema.
    pub schema_data: &'a [u8],
}

/// Message types by name: common ROS types, and those of the folders that a user gives.
#[derive(Clone, Debug)]
pub struct SchemaLibrary {
    ros: Library,
}

impl Default for SchemaLibrary {
    fn default() -> Self {
        Self::builtin()
    }
}

/// The message encodings that gawm decodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Encoding {
    Cdr,
    Ros1,
    Protobuf,
    Json,
}

/// A channel's types.
pub(crate) struct Types {
    pub(crate) encoding: Encoding,
    pub(crate) table: TypeTable,
    /// Protobuf only.
    pub(crate) descriptor: Option<MessageDescriptor>,
    /// Turns payloads into what `encoding` says, where they are not that already.
    pub(crate) transcoder: Option<Transcoder>,
}

impl SchemaLibrary {
    /// Returns the types that gawm knows without being told: std_msgs, geometry_msgs, sensor_msgs and others.
    pub fn builtin() -> Self {
        Self { ros: Library::builtin() }
    }

    /// Adds the .msg files below a folder in the layout of ROS packages, `<package>/msg/<Type>.msg`.
    ///
    /// They replace built-in types of the same name.
    ///
    /// # Errors
    /// [`SchemaFolderError`] if the folder cannot be read, holds no .msg file, or one that does not parse.
    pub fn add_folder(&mut self, folder: &Path) -> Result<(), SchemaFolderError> {
        self.ros.add_folder(folder)
    }

    /// Tells whether `pkg/Type` or `pkg/msg/Type` is known.
    pub fn contains(&self, type_name: &str) -> bool {
        self.ros.find(&super::schema::ros_msg::canonical(type_name), Dialect::Ros2).is_some()
    }

    pub(crate) fn types(&self, channel: &ChannelSchema<'_>) -> Result<Types, CompileError> {
        match (channel.message_encoding, channel.schema_encoding) {
            // Some writers leave the message encoding out, or name the middleware.
            ("cdr" | "ros2", "ros2msg" | "ros1msg" | "") | ("", "ros2msg") => {
                self.ros_types(channel, Encoding::Cdr, Dialect::Ros2)
            }
            ("cdr" | "ros2" | "", "ros2idl" | "omgidl") => {
                let table = ros_idl::parse_schema(channel.schema_name, channel.schema_data, &self.ros);
                Ok(cdr_types(table.map_err(|fault| ros_fault(channel, fault))?))
            }
            ("flatbuffer", "flatbuffer") => flatbuffer_types(channel),
            ("cbor", "" | "jsonschema") => Ok(Types {
                transcoder: Some(Transcoder::Cbor),
                ..json_types(json_schema::type_table(channel.schema_name, channel.schema_data), channel)?
            }),
            ("cbor", _) => Ok(Types { transcoder: Some(Transcoder::Cbor), ..open_types() }),
            ("ros1", "ros1msg" | "") | ("", "ros1msg") => {
                self.ros_types(channel, Encoding::Ros1, Dialect::Ros1)
            }
            ("protobuf" | "", "protobuf") => protobuf_types(channel),
            // A JSON schema says that messages are JSON, whatever the channel is labelled.
            ("json", "" | "jsonschema") | ("" | "cdr" | "ros1" | "protobuf", "jsonschema") => {
                json_types(json_schema::type_table(channel.schema_name, channel.schema_data), channel)
            }
            // Some writers name no schema encoding that fits; JSON needs none.
            ("json", _) => Ok(open_types()),
            _ => Err(unsupported(channel)),
        }
    }

    fn ros_types(
        &self,
        channel: &ChannelSchema<'_>,
        encoding: Encoding,
        dialect: Dialect,
    ) -> Result<Types, CompileError> {
        let has_text = channel.schema_data.iter().any(|b| !b.is_ascii_whitespace());
        let known = library_type(channel.schema_name, dialect, &self.ros);
        let table = if has_text {
            parse_schema(channel.schema_name, channel.schema_data, dialect, &self.ros)
        } else if let Some(known) = known {
            known
        } else if channel.schema_encoding.is_empty() || channel.schema_name.is_empty() {
            return Err(CompileError::NoSchema {
                topic: channel.topic.to_owned(),
                schema_name: channel.schema_name.to_owned(),
            });
        } else {
            // An empty definition is that of a message without fields.
            parse_schema(channel.schema_name, b"", dialect, &self.ros)
        };
        let table = table.map_err(|fault| ros_fault(channel, fault))?;
        if encoding == Encoding::Cdr {
            return Ok(cdr_types(table));
        }
        Ok(Types { encoding, table, descriptor: None, transcoder: None })
    }
}

fn cdr_types(table: TypeTable) -> Types {
    let transcoder = Some(Transcoder::Cdr2(Arc::new(table.clone())));
    Types { encoding: Encoding::Cdr, table, descriptor: None, transcoder }
}

fn json_types(table: Result<TypeTable, String>, channel: &ChannelSchema<'_>) -> Result<Types, CompileError> {
    Ok(Types { table: table.map_err(|detail| bad_schema(channel, detail))?, ..open_types() })
}

fn open_types() -> Types {
    Types { encoding: Encoding::Json, table: json_schema::open(), descriptor: None, transcoder: None }
}

fn flatbuffer_types(channel: &ChannelSchema<'_>) -> Result<Types, CompileError> {
    let reflection = Reflection::parse(channel.schema_name, channel.schema_data)
        .map_err(|detail| bad_schema(channel, detail))?;
    let table = reflection.type_table();
    Ok(Types { table, transcoder: Some(Transcoder::Flatbuffer(Arc::new(reflection))), ..open_types() })
}

fn protobuf_types(channel: &ChannelSchema<'_>) -> Result<Types, CompileError> {
    let wrap = |detail| bad_schema(channel, detail);
    let descriptor = proto::message_descriptor(channel.schema_name, channel.schema_data).map_err(wrap)?;
    let table = proto::type_table(&descriptor).map_err(wrap)?;
    Ok(Types { encoding: Encoding::Protobuf, table, descriptor: Some(descriptor), transcoder: None })
}

fn unsupported(channel: &ChannelSchema<'_>) -> CompileError {
    let is_known = matches!(channel.message_encoding, "cdr" | "ros1" | "protobuf");
    if is_known && channel.schema_encoding.is_empty() {
        return CompileError::NoSchema {
            topic: channel.topic.to_owned(),
            schema_name: channel.schema_name.to_owned(),
        };
    }
    CompileError::UnsupportedEncoding {
        topic: channel.topic.to_owned(),
        message_encoding: channel.message_encoding.to_owned(),
        schema_encoding: channel.schema_encoding.to_owned(),
    }
}

fn bad_schema(channel: &ChannelSchema<'_>, detail: String) -> CompileError {
    CompileError::BadSchema {
        topic: channel.topic.to_owned(),
        schema_name: channel.schema_name.to_owned(),
        schema_encoding: channel.schema_encoding.to_owned(),
        detail,
    }
}

fn ros_fault(channel: &ChannelSchema<'_>, fault: Fault) -> CompileError {
    let (topic, schema_name) = (channel.topic.to_owned(), channel.schema_name.to_owned());
    match fault {
        Fault::Service => CompileError::ServiceSchema { topic, schema_name },
        Fault::UnknownType { field, type_name } => {
            CompileError::UnknownType { topic, schema_name, field, type_name }
        }
        fault => bad_schema(channel, describe(&fault)),
    }
}

impl<'a> From<&'a crate::log::Channel> for ChannelSchema<'a> {
    fn from(channel: &'a crate::log::Channel) -> Self {
        let schema = channel.schema.as_deref();
        Self {
            topic: &channel.topic,
            message_encoding: &channel.message_encoding,
            schema_name: schema.map_or("", |s| &s.name),
            schema_encoding: schema.map_or("", |s| &s.encoding),
            schema_data: schema.map_or(&[], |s| &s.data),
        }
    }
}
