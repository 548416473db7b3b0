//! Typed access to the bytes of a slot.

use super::{BatchError, BatchLayout, BatchShape, SECTION_ALIGNMENT, Section, SlotHeader};

/// A batch in a slot: typed slices of the slot's own bytes, nothing copied.
///
/// All arrays have as many clips as the header says, which is `B` except in the last batch of a small validation set.
#[derive(Debug, Clone, Copy)]
pub struct BatchView<'a> {
    header: SlotHeader,
    shape: BatchShape,
    clip_ids: &'a [u64],
    frames: &'a [u8],
    actions: &'a [f32],
    states: &'a [f32],
    action_mask: &'a [u8],
    state_mask: &'a [u8],
    frame_mask: &'a [u8],
}

impl<'a> BatchView<'a> {
    /// Checks the header and makes a view. Numbers and masks are not looked at.
    ///
    /// # Errors
    /// - [`BatchError::Short`] or [`BatchError::Unaligned`] if the memory cannot hold the layout
    /// - [`BatchError::Header`] if the header is not one of this layout
    pub fn try_new(layout: &BatchLayout, slot: &'a [u8]) -> Result<BatchView<'a>, BatchError> {
        check_memory(layout, slot)?;
        let header = SlotHeader::read(layout, slot)?;
        let clips = header.clips;
        let bytes = |section: Section| {
            let start = layout.offset(section);
            &slot[start..start + clips * layout.shape().clip_bytes(section)]
        };
        Ok(BatchView {
            header,
            shape: BatchShape { clips, ..*layout.shape() },
            clip_ids: numbers(bytes(Section::ClipIds))?,
            frames: bytes(Section::Frames),
            actions: numbers(bytes(Section::Actions))?,
            states: numbers(bytes(Section::States))?,
            action_mask: bytes(Section::ActionMask),
            state_mask: bytes(Section::StateMask),
            frame_mask: bytes(Section::FrameMask),
        })
    }

    /// Returns the header.
    pub fn header(&self) -> &SlotHeader {
        &self.header
    }

    /// Returns the shape; `clips` is the number of clips that are there.
    pub fn shape(&self) -> &BatchShape {
        &self.shape
    }

    /// Returns the clip ids, shape `[B]`: dataset number in the upper 16 bits, the first row of the clip in the others.
    pub fn clip_ids(&self) -> &'a [u64] {
        self.clip_ids
    }

    /// Returns the frames, shape [B, T, V, H, W, C].
    pub fn frames(&self) -> &'a [u8] {
        self.frames
    }

    /// Returns the standardised action chunks, shape [B, T, A]; chunk t acts between frames t and t + 1.
    pub fn actions(&self) -> &'a [f32] {
        self.actions
    }

    /// Returns the standardised states, shape [B, T, S].
    pub fn states(&self) -> &'a [f32] {
        self.states
    }

    /// Returns which action chunks are whole, shape [B, T]; not 0 means valid.
    pub fn action_mask(&self) -> &'a [u8] {
        self.action_mask
    }

    /// Returns which state values are valid, shape [B, T, S]; not 0 means valid.
    pub fn state_mask(&self) -> &'a [u8] {
        self.state_mask
    }

    /// Returns which frames are of their tick, shape [B, T, V]; not 0 means valid.
    pub fn frame_mask(&self) -> &'a [u8] {
        self.frame_mask
    }
}

/// The sections of a slot that is being filled: typed, disjoint, for all `B` clips. The header is not among them.
#[derive(Debug)]
pub struct SectionsMut<'a> {
    /// Clip ids, shape `[B]`.
    pub clip_ids: &'a mut [u64],
    /// Frames, shape [B, T, V, H, W, C].
    pub frames: &'a mut [u8],
    /// Action chunks, shape [B, T, A].
    pub actions: &'a mut [f32],
    /// States, shape [B, T, S].
    pub states: &'a mut [f32],
    /// Validity of action chunks, shape [B, T].
    pub action_mask: &'a mut [u8],
    /// Validity of state values, shape [B, T, S].
    pub state_mask: &'a mut [u8],
    /// Validity of frames, shape [B, T, V].
    pub frame_mask: &'a mut [u8],
}

impl<'a> SectionsMut<'a> {
    /// Splits a slot into its sections.
    ///
    /// # Errors
    /// [`BatchError::Short`] or [`BatchError::Unaligned`] if the memory cannot hold the layout.
    pub fn try_new(layout: &BatchLayout, slot: &'a mut [u8]) -> Result<SectionsMut<'a>, BatchError> {
        check_memory(layout, slot)?;
        let mut rest = slot;
        let mut at = 0;
        let mut next = |section: Section| {
            let (start, length) = (layout.offset(section), layout.section_bytes(section));
            let (head, tail) = std::mem::take(&mut rest).split_at_mut(start + length - at);
            rest = tail;
            let skipped = start - at;
            at = start + length;
            &mut head[skipped..]
        };
        Ok(SectionsMut {
            clip_ids: numbers_mut(next(Section::ClipIds))?,
            frames: next(Section::Frames),
            actions: numbers_mut(next(Section::Actions))?,
            states: numbers_mut(next(Section::States))?,
            action_mask: next(Section::ActionMask),
            state_mask: next(Section::StateMask),
            frame_mask: next(Section::FrameMask),
        })
    }
}

fn check_memory(layout: &BatchLayout, slot: &[u8]) -> Result<(), BatchError> {
    if slot.len() < layout.total_bytes() {
        return Err(BatchError::Short { expected: layout.total_bytes(), got: slot.len() });
    }
    match slot.as_ptr().addr() % SECTION_ALIGNMENT {
        0 => Ok(()),
        got => Err(BatchError::Unaligned { got }),
    }
}

/// Cannot fail behind [`check_memory`]: sections begin at multiples of 64 bytes and hold whole numbers.
fn numbers<T: bytemuck::AnyBitPattern>(bytes: &[u8]) -> Result<&[T], BatchError> {
    let got = bytes.as_ptr().addr() % SECTION_ALIGNMENT;
    bytemuck::try_cast_slice(bytes).map_err(|_error| BatchError::Unaligned { got })
}

fn numbers_mut<T: bytemuck::Pod>(bytes: &mut [u8]) -> Result<&mut [T], BatchError> {
    let got = bytes.as_ptr().addr() % SECTION_ALIGNMENT;
    bytemuck::try_cast_slice_mut(bytes).map_err(|_error| BatchError::Unaligned { got })
}
