//! Image messages of any encoding: what they say of the image, and its bytes, borrowed where the encoding allows.

use std::borrow::Cow;
use std::io::Read as _;

use super::channel::{ChannelSchema, Encoding, SchemaLibrary, Types};
use super::error::{CompileError, DecodeError};
use super::path::FieldPath;
use super::plan::{Core, StampSource};
use super::resolve::Want;
use super::row::{ExactRow, Held, Number, RowSink};
use super::schema::{Base, Prim, TypeTable};
use super::stamp::StampForm;

/// First bytes of a zstd frame.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// How to take the image out of the messages of one channel.
#[derive(Debug)]
pub struct ImagePlan {
    core: Core,
    /// Which part each slot is.
    parts: Vec<Part>,
    /// `None` where each message tells by its members: channels without a schema.
    kind: Option<ImageKind>,
    stamp: StampForm,
}

/// Whether messages hold pixels or a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageKind {
    /// Rows of pixels in a named layout.
    Raw,
    /// JPEG, PNG or another file format.
    Compressed,
    /// A packet of a video.
    Video,
}

/// One image message.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageMessage<'a> {
    /// Whether `data` is pixels or a file.
    pub kind: ImageKind,
    /// Stamp in nanoseconds; absent if the message has none or 0.
    pub stamp_ns: Option<i64>,
    /// Coordinate frame; empty if not named.
    pub frame_id: Cow<'a, str>,
    /// Layout (`rgb8`) of raw images, format (`jpeg`) of compressed ones, as the message says.
    pub format: Cow<'a, str>,
    /// Width in pixels; 0 for compressed images.
    pub width: u32,
    /// Height in pixels; 0 for compressed images.
    pub height: u32,
    /// Bytes of a row, padding included; 0 for compressed images.
    pub step: u32,
    /// Whether values of 16 and 32 bits are big-endian.
    pub is_big_endian: bool,
    /// Pixels or file.
    pub data: Cow<'a, [u8]>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    FrameId,
    /// Layout of pixels, beside which a message without a schema is no file.
    Layout,
    Format,
    Width,
    Height,
    Step,
    BigEndian,
    Data,
}

impl ImageMessage<'_> {
    /// Copies what is borrowed.
    fn into_owned(self) -> ImageMessage<'static> {
        ImageMessage {
            kind: self.kind,
            stamp_ns: self.stamp_ns,
            frame_id: Cow::Owned(self.frame_id.into_owned()),
            format: Cow::Owned(self.format.into_owned()),
            width: self.width,
            height: self.height,
            step: self.step,
            is_big_endian: self.is_big_endian,
            data: Cow::Owned(self.data.into_owned()),
        }
    }
}

impl ImagePlan {
    /// Compiles a plan for sensor_msgs Image and CompressedImage, foxglove RawImage, CompressedImage and CompressedVideo, and
    /// types like them.
    ///
    /// # Errors
    /// [`CompileError::NotAnImage`] if the type has no image's fields, names video in a build without it, or the channel
    /// cannot be decoded.
    pub fn compile(channel: &ChannelSchema<'_>, library: &SchemaLibrary) -> Result<Self, CompileError> {
        let types = library.types(channel)?;
        let not_image = |detail: String| CompileError::NotAnImage { topic: channel.topic.to_owned(), detail };
        let is_video = channel.schema_name.ends_with("CompressedVideo");
        if is_video && !gawm_video::IS_BUILT {
            return Err(not_image(format!(
                "{} holds video packets, which this build does not decode; {}",
                channel.schema_name,
                crate::VIDEO_HINT
            )));
        }
        let has = |path: &[&str]| has_path(&types.table, path);
        let is_open = types.encoding == Encoding::Json && types.table.root().fields.is_empty();
        if is_open && !is_video {
            return Self::open(channel, &types);
        }
        let kind = if is_video {
            ImageKind::Video
        } else if has(&["width"]) && has(&["height"]) {
            ImageKind::Raw
        } else {
            ImageKind::Compressed
        };
        if !is_open && !has(&["data"]) {
            return Err(not_image(format!("type {:?} has no field \"data\"", channel.schema_name)));
        }
        let mut wanted = vec![(Part::Data, vec!["data"])];
        match kind {
            ImageKind::Raw => wanted.extend([
                (Part::Format, vec!["encoding"]),
                (Part::Width, vec!["width"]),
                (Part::Height, vec!["height"]),
                (Part::Step, vec!["step"]),
                (Part::BigEndian, vec!["is_bigendian"]),
            ]),
            ImageKind::Compressed | ImageKind::Video => wanted.push((Part::Format, vec!["format"])),
        }
        wanted.extend([(Part::FrameId, vec!["header", "frame_id"]), (Part::FrameId, vec!["frame_id"])]);
        let fields = Self::present(&types, is_open, &wanted);
        if kind == ImageKind::Raw && !fields.iter().any(|(part, _)| *part == Part::Format) {
            return Err(not_image("it names no pixel layout (field \"encoding\")".to_owned()));
        }
        let want = |part: &Part| if *part == Part::Data { Want::Bytes } else { Want::Scalars };
        let fields: Vec<_> = fields.into_iter().map(|(part, path)| (part, path, want(&part))).collect();
        Self::build(channel, &types, Some(kind), &fields)
    }

    /// Compiles a plan for messages without a schema: all that images have is looked for.
    fn open(channel: &ChannelSchema<'_>, types: &Types) -> Result<Self, CompileError> {
        let parts = [
            (Part::Data, "data"),
            (Part::Layout, "encoding"),
            (Part::Format, "format"),
            (Part::Width, "width"),
            (Part::Height, "height"),
            (Part::Step, "step"),
            (Part::BigEndian, "is_bigendian"),
            (Part::BigEndian, "is_big_endian"),
        ];
        let want = |part: &Part| if *part == Part::Data { Want::Bytes } else { Want::Optional };
        let fields: Vec<_> =
            parts.iter().map(|(part, name)| (*part, FieldPath::from_members([*name]), want(part))).collect();
        Self::build(channel, types, None, &fields)
    }

    fn present(types: &Types, is_open: bool, wanted: &[(Part, Vec<&str>)]) -> Vec<(Part, FieldPath)> {
        // What a JSON schema leaves open may be in the messages all the same.
        let may_have = |part: &Part, path: &[&str]| match types.encoding {
            Encoding::Json if *part == Part::FrameId => false,
            // Only of videos: other images without a schema are told apart message by message.
            Encoding::Json if is_open => true,
            _ => has_path(&types.table, path),
        };
        wanted
            .iter()
            .filter(|(part, path)| may_have(part, path))
            .map(|(part, path)| (*part, FieldPath::from_members(path.iter().copied())))
            .collect()
    }

    fn build(
        channel: &ChannelSchema<'_>,
        types: &Types,
        kind: Option<ImageKind>,
        fields: &[(Part, FieldPath, Want)],
    ) -> Result<Self, CompileError> {
        let wants: Vec<(FieldPath, Want)> =
            fields.iter().map(|(_, path, want)| (path.clone(), *want)).collect();
        let (core, slots, stamp) = Core::compile(channel, types, &wants, &StampSource::Auto)?;
        if slots.iter().any(|range| range.len() != 1) {
            let detail = "its fields are not those of an image".to_owned();
            return Err(CompileError::NotAnImage { topic: channel.topic.to_owned(), detail });
        }
        let parts = fields.iter().map(|(part, ..)| *part).collect();
        Ok(Self { core, parts, kind, stamp })
    }

    /// Tells whether messages hold pixels or a file; `None` where each message tells by itself.
    pub fn kind(&self) -> Option<ImageKind> {
        self.kind
    }

    /// Takes the image out of one message; data is borrowed unless it is base64.
    ///
    /// The sink serves as scratch memory; nothing is appended to it.
    ///
    /// # Errors
    /// [`DecodeError`] if the message does not fit its schema.
    pub fn extract<'a>(
        &self,
        payload: &'a [u8],
        sink: &mut RowSink,
    ) -> Result<ImageMessage<'a>, DecodeError> {
        match self.core.transcoded(payload)? {
            Cow::Borrowed(payload) => self.extract_plain(payload, sink),
            Cow::Owned(payload) => Ok(self.extract_plain(&payload, sink)?.into_owned()),
        }
    }

    fn extract_plain<'a>(
        &self,
        payload: &'a [u8],
        sink: &mut RowSink,
    ) -> Result<ImageMessage<'a>, DecodeError> {
        let mut emit = ExactRow::new(self.parts.len());
        self.core.run(payload, &mut sink.scratch, &mut emit)?;
        let mut image = ImageMessage {
            kind: self.kind.unwrap_or(ImageKind::Compressed),
            stamp_ns: emit.stamp.finish(self.stamp),
            frame_id: Cow::Borrowed(""),
            format: Cow::Borrowed(""),
            width: 0,
            height: 0,
            step: 0,
            is_big_endian: false,
            data: Cow::Borrowed(&[]),
        };
        for (i, (part, held)) in self.parts.iter().zip(emit.values).enumerate() {
            let path = &self.core.requests.leaves[i].path;
            match (part, held) {
                (Part::Data, Some(Held::Bytes(data))) => image.data = data,
                (Part::Layout, Some(Held::Text(text))) => {
                    (image.format, image.kind) = (text, ImageKind::Raw);
                }
                (Part::Format, Some(Held::Text(_)))
                    if self.kind.is_none() && image.kind == ImageKind::Raw => {}
                (Part::Format, Some(Held::Text(text))) => image.format = text,
                (Part::FrameId, Some(Held::Text(text))) => image.frame_id = text,
                (Part::Width, Some(Held::Number(n))) => image.width = size(n, path)?,
                (Part::Height, Some(Held::Number(n))) => image.height = size(n, path)?,
                (Part::Step, Some(Held::Number(n))) => image.step = size(n, path)?,
                (Part::BigEndian, Some(Held::Number(n))) => image.is_big_endian = n.widen() != 0.0,
                (_, None) if self.core.requests.leaves[i].is_optional => {}
                (_, held) => {
                    let got = match held {
                        None => "nothing",
                        Some(Held::Text(_)) => "text",
                        Some(Held::Number(_)) => "a number",
                        Some(Held::Bytes(_)) => "bytes",
                    };
                    return Err(DecodeError::WrongType {
                        path: path.clone(),
                        expected: "a part of an image",
                        got: got.to_owned(),
                    });
                }
            }
        }
        if self.kind.is_none() && (image.width == 0 || image.height == 0) {
            // A file may name its format in `encoding`.
            image.kind = ImageKind::Compressed;
        }
        Ok(image)
    }
}

fn size(number: Number, path: &str) -> Result<u32, DecodeError> {
    let size = match number {
        Number::U64(v) => u32::try_from(v).ok(),
        Number::I64(v) => u32::try_from(v).ok(),
        Number::F64(_) | Number::Bool(_) => None,
    };
    size.ok_or_else(|| DecodeError::WrongType {
        path: path.to_owned(),
        expected: "a size in pixels or bytes",
        got: number.widen().to_string(),
    })
}

fn has_path(table: &TypeTable, path: &[&str]) -> bool {
    let mut index = table.root;
    for (i, name) in path.iter().enumerate() {
        let item = &table.structs[index];
        let Some(at) = item.find(name) else { return false };
        match item.fields[at].base {
            Base::Struct(inner) if i + 1 < path.len() => index = inner,
            Base::Prim(prim) if i + 1 == path.len() => {
                return match *name {
                    "data" => matches!(prim, Prim::Bytes | Prim::U8 | Prim::I8 | Prim::Text),
                    _ => true,
                };
            }
            _ => return false,
        }
    }
    false
}

/// Why a compressed message body cannot be unpacked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DecompressError {
    /// The body is larger than the cap when unpacked.
    #[error("message body is larger than {limit} bytes when decompressed")]
    TooLarge {
        /// The cap in bytes.
        limit: usize,
    },
    /// The body is no whole zstd frame.
    #[error("message body is not a whole zstd frame: {source}")]
    Damaged {
        /// What the decoder says.
        source: std::io::Error,
    },
}

/// Tells whether a message body was compressed by itself, as rosbag2 does with compression mode MESSAGE.
pub fn is_compressed_message(payload: &[u8]) -> bool {
    payload.starts_with(&ZSTD_MAGIC)
}

/// Unpacks a message body that [`is_compressed_message`]; at most `limit` bytes are made.
///
/// # Errors
/// [`DecompressError`] if the body is damaged or larger.
pub fn decompress_message(payload: &[u8], limit: usize) -> Result<Vec<u8>, DecompressError> {
    let wrap = |source| DecompressError::Damaged { source };
    let decoder = zstd::stream::read::Decoder::new(payload).map_err(wrap)?;
    let mut out = Vec::new();
    let cap = u64::try_from(limit).unwrap_or(u64::MAX).saturating_add(1);
    decoder.take(cap).read_to_end(&mut out).map_err(wrap)?;
    if out.len() > limit {
        return Err(DecompressError::TooLarge { limit });
    }
    Ok(out)
}
