//! Where the parts of a batch lie in a slot.

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::{BatchError, SLOT_HEADER_BYTES, SLOT_VERSION};
use crate::ContentHash;

/// Alignment of every section in bytes: a cache line, and enough for any vector instruction.
pub const SECTION_ALIGNMENT: usize = 64;

/// Largest length of one axis. It keeps products of two axes far from overflow and is above any use.
const MAX_AXIS: usize = 1 << 20;

/// Largest slot in bytes (64 GiB); a larger one is a mistake in the configuration.
const MAX_SLOT_BYTES: u64 = 64 << 30;

/// The size of one batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchShape {
    /// `B`: clips of a full batch.
    pub clips: usize,
    /// `T`: frames of a clip, history and predicted together.
    pub frames: usize,
    /// `V`: cameras.
    pub views: usize,
    /// `H`: rows of pixels.
    pub height: usize,
    /// `W`: columns of pixels.
    pub width: usize,
    /// `C`: channels of a pixel, 1 or 3.
    pub channels: usize,
    /// `A`: numbers of an action chunk: frameskip times the dims of the encoded action, step by step.
    pub action_width: usize,
    /// `S`: dims of the encoded state; 0 without state.
    pub state_width: usize,
}

/// One array in a slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Section {
    /// Clip ids, u64, shape `[B]`.
    ClipIds,
    /// Frames, u8 [B, T, V, H, W, C].
    Frames,
    /// Standardised action chunks, f32 [B, T, A]; 0 where the mask is 0.
    Actions,
    /// Standardised states, f32 [B, T, S]; 0 where the mask is 0.
    States,
    /// Validity of action chunks, u8 [B, T].
    ActionMask,
    /// Validity of state values, u8 [B, T, S].
    StateMask,
    /// Validity of frames, u8 [B, T, V].
    FrameMask,
}

impl Section {
    /// All sections in the order they have in a slot.
    pub const ALL: [Section; 7] = [
        Section::ClipIds,
        Section::Frames,
        Section::Actions,
        Section::States,
        Section::ActionMask,
        Section::StateMask,
        Section::FrameMask,
    ];

    /// Returns the name that the format's document uses.
    pub fn name(self) -> &'static str {
        match self {
            Section::ClipIds => "clip_ids",
            Section::Frames => "frames",
            Section::Actions => "actions",
            Section::States => "states",
            Section::ActionMask => "action_mask",
            Section::StateMask => "state_mask",
            Section::FrameMask => "frame_mask",
        }
    }
}

impl BatchShape {
    /// Returns the bytes that one clip has in a section.
    pub fn clip_bytes(&self, section: Section) -> usize {
        let frame = self.height * self.width * self.channels;
        match section {
            Section::ClipIds => 8,
            Section::Frames => self.frames * self.views * frame,
            Section::Actions => self.frames * self.action_width * 4,
            Section::States => self.frames * self.state_width * 4,
            Section::ActionMask => self.frames,
            Section::StateMask => self.frames * self.state_width,
            Section::FrameMask => self.frames * self.views,
        }
    }

    /// Returns the bytes of one frame of one camera.
    pub fn frame_bytes(&self) -> usize {
        self.height * self.width * self.channels
    }

    fn axes(&self) -> [(&'static str, usize); 8] {
        [
            ("clips", self.clips),
            ("frames", self.frames),
            ("views", self.views),
            ("height", self.height),
            ("width", self.width),
            ("channels", self.channels),
            ("action_width", self.action_width),
            ("state_width", self.state_width),
        ]
    }
}

/// Offsets of the sections in a slot: a pure function of the shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BatchLayout {
    shape: BatchShape,
    offsets: [usize; 7],
    total_bytes: usize,
    /// Kept, since every slot is compared with it.
    hash: ContentHash,
}

impl BatchLayout {
    /// Lays a batch out: the header, then the sections in the order of [`Section::ALL`], each 64-byte aligned.
    ///
    /// # Errors
    /// [`BatchError::Shape`] if an axis is 0 (except `state_width`) or above 2^20, `channels` is neither 1 nor 3, or the
    /// whole is above 64 GiB.
    pub fn try_new(shape: BatchShape) -> Result<BatchLayout, BatchError> {
        for (field, got) in shape.axes() {
            let is_possible = got <= MAX_AXIS && (got > 0 || field == "state_width");
            if !is_possible {
                let got = got as u64;
                return Err(BatchError::Shape { field, expected: "axes of 1 to 1048576", got });
            }
        }
        if !matches!(shape.channels, 1 | 3) {
            let got = shape.channels as u64;
            return Err(BatchError::Shape { field: "channels", expected: "1 or 3 channels", got });
        }
        let mut end = SLOT_HEADER_BYTES as u64;
        let mut offsets = [0; 7];
        for (offset, bytes) in offsets.iter_mut().zip(section_bytes(&shape)) {
            let next = bytes.and_then(|bytes| end.checked_add(bytes)).filter(|end| *end <= MAX_SLOT_BYTES);
            let (Some(next), Ok(start)) = (next, usize::try_from(end)) else {
                let got = bytes.unwrap_or(u64::MAX);
                return Err(BatchError::Shape {
                    field: "bytes of a section",
                    expected: "at most 64 GiB",
                    got,
                });
            };
            *offset = start;
            end = next.next_multiple_of(SECTION_ALIGNMENT as u64);
        }
        let total_bytes = usize::try_from(end).map_err(|_error| BatchError::Shape {
            field: "bytes",
            expected: "a slot that can be addressed",
            got: end,
        })?;
        let hash = hash(&shape, &offsets, total_bytes);
        Ok(BatchLayout { shape, offsets, total_bytes, hash })
    }

    /// Returns the shape.
    pub fn shape(&self) -> &BatchShape {
        &self.shape
    }

    /// Returns where a section begins.
    pub fn offset(&self, section: Section) -> usize {
        self.offsets[section as usize]
    }

    /// Returns the length of a section in bytes, without padding, for a full batch.
    pub fn section_bytes(&self, section: Section) -> usize {
        self.shape.clips * self.shape.clip_bytes(section)
    }

    /// Returns the bytes of a slot; a multiple of 64.
    pub fn total_bytes(&self) -> usize {
        self.total_bytes
    }

    /// Returns a hash of version, shape and offsets: two sides with equal hashes agree on every byte.
    pub fn hash(&self) -> ContentHash {
        self.hash
    }
}

fn hash(shape: &BatchShape, offsets: &[usize; 7], total_bytes: usize) -> ContentHash {
    ContentHash::of_json(&json!({
        "format": "gawm slot",
        "version": SLOT_VERSION,
        "shape": shape.axes().map(|(name, length)| json!([name, length])),
        "offsets": Section::ALL.map(|section| json!([section.name(), offsets[section as usize]])),
        "total_bytes": total_bytes,
    }))
}

/// Returns the length of each section; `None` where it overflows.
fn section_bytes(shape: &BatchShape) -> [Option<u64>; 7] {
    let product = |axes: &[usize]| axes.iter().try_fold(1_u64, |p, axis| p.checked_mul(*axis as u64));
    let BatchShape { clips, frames, views, height, width, channels, action_width, state_width } = *shape;
    [
        product(&[clips, 8]),
        product(&[clips, frames, views, height, width, channels]),
        product(&[clips, frames, action_width, 4]),
        product(&[clips, frames, state_width, 4]),
        product(&[clips, frames]),
        product(&[clips, frames, state_width]),
        product(&[clips, frames, views]),
    ]
}
