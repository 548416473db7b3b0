//! Hashes of schemas and contents.

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A BLAKE3 hash, written as 64 hexadecimal digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ContentHash(pub [u8; 32]);

impl ContentHash {
    /// Hashes bytes.
    pub fn of(bytes: &[u8]) -> ContentHash {
        ContentHash(*blake3::hash(bytes).as_bytes())
    }

    /// Hashes a JSON value in canonical form: objects sorted by key, no white space.
    pub fn of_json(value: &Value) -> ContentHash {
        ContentHash::of(canonical_json(value).as_bytes())
    }
}

impl std::fmt::Display for ContentHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl From<ContentHash> for String {
    fn from(hash: ContentHash) -> String {
        hash.to_string()
    }
}

impl TryFrom<String> for ContentHash {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let digits = text.as_bytes();
        if digits.len() != 64 {
            return Err(format!("expected a hash of 64 hexadecimal digits, got {} characters", digits.len()));
        }
        let digit = |c: u8| (c as char).to_digit(16).map(|d| d as u8);
        let mut hash = [0; 32];
        for (byte, pair) in hash.iter_mut().zip(digits.chunks(2)) {
            let (Some(high), Some(low)) = (digit(pair[0]), digit(pair[1])) else {
                return Err("expected a hash of 64 hexadecimal digits, got other characters".to_owned());
            };
            *byte = high << 4 | low;
        }
        Ok(ContentHash(hash))
    }
}

/// Returns a JSON value as text with objects sorted by key and no white space.
pub fn canonical_json(value: &Value) -> String {
    fn sorted(value: &Value) -> Value {
        match value {
            Value::Object(map) => {
                let mut entries: Vec<_> = map.iter().collect();
                entries.sort_by(|a, b| a.0.cmp(b.0));
                Value::Object(entries.into_iter().map(|(k, v)| (k.clone(), sorted(v))).collect())
            }
            Value::Array(items) => Value::Array(items.iter().map(sorted).collect()),
            other => other.clone(),
        }
    }
    sorted(value).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn order_of_keys_does_not_matter() {
        let a = json!({"b": [1, {"y": 2.5, "x": null}], "a": "ä"});
        let b = json!({"a": "ä", "b": [1, {"x": null, "y": 2.5}]});
        assert_eq!(ContentHash::of_json(&a), ContentHash::of_json(&b));
        assert_eq!(canonical_json(&a), r#"{"a":"ä","b":[1,{"x":null,"y":2.5}]}"#);
        assert_ne!(ContentHash::of_json(&a), ContentHash::of_json(&json!({"a": "ä"})));
    }

    #[test]
    fn text_round_trips_and_other_text_is_refused() {
        let hash = ContentHash::of(b"");
        assert!(hash.to_string().starts_with("af1349b9f5f9a1a6"), "{hash}");
        assert_eq!(ContentHash::try_from(hash.to_string()), Ok(hash));
        assert!(ContentHash::try_from("00".to_owned()).is_err());
        assert!(ContentHash::try_from("zz".repeat(32)).is_err());
    }
}
