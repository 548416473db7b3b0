//! The BloscLZ codec: runs of literals and back references, as c-blosc writes them.

/// Back references beyond this distance carry a 16-bit distance (c-blosc `MAX_DISTANCE`).
const FAR_DISTANCE: usize = 8191;

/// Decompresses `stream` into `out` and returns the bytes written.
///
/// A control byte below 32 starts `control + 1` literals; one above holds a length (upper 3 bits, more
/// bytes when 7) and the upper 5 bits of a distance. The upper bits of the first control byte are a
/// format tag.
pub(crate) fn decompress(stream: &[u8], out: &mut [u8]) -> Result<usize, &'static str> {
    let Some((&first, mut input)) = stream.split_first() else { return Ok(0) };
    let mut control = usize::from(first & 31);
    let mut at = 0;
    loop {
        if control >= 32 {
            let (len, distance) = reference(control, &mut input)?;
            copy_match(out, at, len, distance)?;
            at += len;
        } else {
            let len = control + 1;
            let (literals, rest) = input.split_at_checked(len).ok_or("literals are cut")?;
            out.get_mut(at..at + len)
                .ok_or("literals run past the end of the block")?
                .copy_from_slice(literals);
            input = rest;
            at += len;
        }
        match input.split_first() {
            Some((&next, rest)) => (control, input) = (usize::from(next), rest),
            None => return Ok(at),
        }
    }
}

fn next(input: &mut &[u8]) -> Result<usize, &'static str> {
    let (&byte, rest) = input.split_first().ok_or("a back reference is cut")?;
    *input = rest;
    Ok(usize::from(byte))
}

/// Reads the rest of a back reference: its length and its distance.
fn reference(control: usize, input: &mut &[u8]) -> Result<(usize, usize), &'static str> {
    let mut len = (control >> 5) - 1;
    let high = (control & 31) << 8;
    if len == 6 {
        loop {
            let more = next(input)?;
            len += more;
            if more != 255 {
                break;
            }
        }
    }
    let low = next(input)?;
    let mut distance = high + low;
    if low == 255 && high == 31 << 8 {
        distance = (next(input)? << 8) + next(input)? + FAR_DISTANCE;
    }
    Ok((len + 3, distance + 1))
}

fn copy_match(out: &mut [u8], at: usize, len: usize, distance: usize) -> Result<(), &'static str> {
    let from = at.checked_sub(distance).ok_or("a back reference points before the block")?;
    if len > out.len() - at {
        return Err("a back reference runs past the end of the block");
    }
    if distance >= len {
        out.copy_within(from..from + len, at);
    } else {
        for i in 0..len {
            out[at + i] = out[from + i];
        }
    }
    Ok(())
}
