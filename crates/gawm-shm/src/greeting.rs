//! The first message of a loader: the hello as JSON, with length and hash before it.
//!
//! ```text
//! bytes     type   field
//!  0.. 8    [u8]   magic "GAWMHELO"
//!  8..12    u32    version, 1
//! 12..16    u32    zero
//! 16..24    u64    length of the JSON text in bytes
//! 24..32    u64    zero
//! 32..64    [u8]   BLAKE3 of the JSON text
//! 64..      [u8]   the JSON text
//! ```

use gawm_schema::ContentHash;
use gawm_schema::batch::Hello;

use crate::error::ShmError;

const MAGIC: [u8; 8] = *b"GAWMHELO";
const VERSION: u32 = 1;
const HEAD_BYTES: usize = 64;

/// Returns the bytes that a text takes with its head.
pub(crate) fn length(json: &str) -> usize {
    HEAD_BYTES + json.len()
}

/// Writes the message.
pub(crate) fn write(json: &str, slot: &mut [u8]) {
    slot[..HEAD_BYTES].fill(0);
    slot[..8].copy_from_slice(&MAGIC);
    slot[8..12].copy_from_slice(&VERSION.to_le_bytes());
    slot[16..24].copy_from_slice(&(json.len() as u64).to_le_bytes());
    slot[32..64].copy_from_slice(&ContentHash::of(json.as_bytes()).0);
    slot[HEAD_BYTES..length(json)].copy_from_slice(json.as_bytes());
}

/// Reads the message: copied out once, then checked.
pub(crate) fn read(loader: u32, slot: &[u8]) -> Result<Hello, ShmError> {
    let foreign =
        |expected: &str, got: String| ShmError::Foreign { loader, expected: expected.to_owned(), got };
    let Some((head, rest)) = slot.split_first_chunk::<HEAD_BYTES>() else {
        return Err(foreign("a hello message", format!("{} bytes", slot.len())));
    };
    let head = *head;
    if head[..8] != MAGIC {
        return Err(foreign(
            "a hello message",
            format!("a message that begins with {}", head[..8].escape_ascii()),
        ));
    }
    let number = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| head[at + i]));
    let version = number(8) as u32;
    if version != VERSION {
        return Err(foreign("version 1 of the hello message", version.to_string()));
    }
    let length = number(16);
    let json = usize::try_from(length).ok().and_then(|length| rest.get(..length)).map(<[u8]>::to_vec);
    let Some(json) = json else {
        return Err(foreign("a hello message of the length that it says", format!("{length} bytes")));
    };
    if ContentHash::of(&json).0 != head[32..64] {
        return Err(foreign("a whole hello message", "one whose hash differs".to_owned()));
    }
    Hello::from_json(&json).map_err(|source| ShmError::Hello { loader, source })
}
