//! Which H.264 picture follows which: reference pictures are numbered, so that a lost one shows. FFmpeg fills such holes with
//! copies and says nothing.

/// Follows the numbers of the pictures of one stream.
#[derive(Debug, Default)]
pub(super) struct PictureNumbers {
    /// What the last sequence parameter set says.
    rules: Option<Rules>,
    /// `frame_num` of the last reference picture.
    last: Option<u32>,
}

#[derive(Debug, Clone, Copy)]
struct Rules {
    /// Bits of `frame_num`.
    bits: u32,
    /// Two more bits stand before it.
    has_colour_plane: bool,
    /// Holes are part of the stream.
    allows_gaps: bool,
}

impl PictureNumbers {
    /// Takes an access unit; returns whether a reference picture before it is missing.
    pub(super) fn has_gap(&mut self, access_unit: &[u8]) -> bool {
        let mut has_gap = false;
        for unit in units(access_unit) {
            let Some((header, body)) = unit.split_first() else { continue };
            match header & 0x1f {
                7 => self.rules = rules_of(body).or(self.rules),
                5 => self.last = Some(0),
                1 => {
                    let Some(rules) = self.rules else { continue };
                    let Some(number) = number_of(body, rules) else { continue };
                    let next = self.last.map(|last| last.wrapping_add(1) & ((1 << rules.bits) - 1));
                    let follows = self.last.is_none() || self.last == Some(number) || next == Some(number);
                    has_gap |= !follows && !rules.allows_gaps;
                    let is_reference = header & 0x60 != 0;
                    if is_reference {
                        self.last = Some(number);
                    }
                }
                _ => {}
            }
        }
        has_gap
    }

    /// Forgets the last picture.
    pub(super) fn reset(&mut self) {
        self.last = None;
    }
}

/// Returns the units between start codes.
pub(super) fn units(data: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = data;
    let start = |data: &[u8]| data.windows(3).position(|bytes| bytes == [0, 0, 1]);
    std::iter::from_fn(move || {
        let at = start(rest)?;
        let unit = &rest[at + 3..];
        let end = start(unit).unwrap_or(unit.len());
        rest = &unit[end..];
        Some(&unit[..end])
    })
}

/// Reads `frame_num` of a slice header.
fn number_of(body: &[u8], rules: Rules) -> Option<u32> {
    let mut bits = Bits::new(body);
    bits.code()?; // first_mb_in_slice
    bits.code()?; // slice_type
    bits.code()?; // pic_parameter_set_id
    if rules.has_colour_plane {
        bits.take(2)?;
    }
    bits.take(rules.bits)
}

/// Reads what a sequence parameter set says of picture numbers.
fn rules_of(body: &[u8]) -> Option<Rules> {
    let mut bits = Bits::new(body);
    let profile = bits.take(8)?;
    bits.take(16)?; // constraints, level
    bits.code()?; // seq_parameter_set_id
    let mut has_colour_plane = false;
    if [100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135].contains(&profile) {
        let chroma = bits.code()?;
        has_colour_plane = chroma == 3 && bits.take(1)? == 1;
        bits.code()?; // bit_depth_luma_minus8
        bits.code()?; // bit_depth_chroma_minus8
        bits.take(1)?; // qpprime_y_zero_transform_bypass_flag
        if bits.take(1)? == 1 {
            for list in 0..if chroma == 3 { 12 } else { 8 } {
                if bits.take(1)? == 1 {
                    skip_scaling_list(&mut bits, if list < 6 { 16 } else { 64 })?;
                }
            }
        }
    }
    let number_bits = bits.code()?.checked_add(4).filter(|bits| *bits <= 16)?;
    match bits.code()? {
        0 => {
            bits.code()?; // log2_max_pic_order_cnt_lsb_minus4
        }
        1 => {
            bits.take(1)?;
            bits.code()?;
            bits.code()?;
            for _ in 0..bits.code()?.min(255) {
                bits.code()?;
            }
        }
        _ => {}
    }
    bits.code()?; // max_num_ref_frames
    Some(Rules { bits: number_bits, has_colour_plane, allows_gaps: bits.take(1)? == 1 })
}

fn skip_scaling_list(bits: &mut Bits<'_>, size: u32) -> Option<()> {
    let (mut last, mut next) = (8_i64, 8_i64);
    for _ in 0..size {
        if next != 0 {
            let code = i64::from(bits.code()?);
            let delta = if code % 2 == 1 { (code + 1) / 2 } else { -(code / 2) };
            next = (last + delta).rem_euclid(256);
        }
        if next != 0 {
            last = next;
        }
    }
    Some(())
}

/// Bits of a unit, without the bytes that keep start codes out of it.
struct Bits<'a> {
    body: &'a [u8],
    at: usize,
    /// Zero bytes before `at`.
    n_zeros: u32,
    byte: u8,
    n_left: u32,
}

impl<'a> Bits<'a> {
    fn new(body: &'a [u8]) -> Bits<'a> {
        Bits { body, at: 0, n_zeros: 0, byte: 0, n_left: 0 }
    }

    fn bit(&mut self) -> Option<u32> {
        if self.n_left == 0 {
            let mut byte = *self.body.get(self.at)?;
            if self.n_zeros >= 2 && byte == 3 {
                self.at += 1;
                self.n_zeros = 0;
                byte = *self.body.get(self.at)?;
            }
            self.at += 1;
            self.n_zeros = if byte == 0 { self.n_zeros + 1 } else { 0 };
            (self.byte, self.n_left) = (byte, 8);
        }
        self.n_left -= 1;
        Some(u32::from(self.byte >> self.n_left & 1))
    }

    fn take(&mut self, n: u32) -> Option<u32> {
        (0..n).try_fold(0, |value, _| Some(value << 1 | self.bit()?))
    }

    /// Reads an Exp-Golomb code.
    fn code(&mut self) -> Option<u32> {
        let mut n = 0;
        while self.bit()? == 0 {
            n += 1;
            if n > 31 {
                return None;
            }
        }
        Some((1_u32 << n) - 1 + self.take(n)?)
    }
}
