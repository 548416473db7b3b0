//! A place in a JSON text, and how to read or step over what stands there.

use std::borrow::Cow;

use super::super::error::DecodeError;
use super::super::row::Number;

/// Deepest nesting that is read.
const MAX_DEPTH: usize = 128;

/// A place in a JSON text. Besides JSON proper it takes `NaN` and `Infinity`, which Python writes.
#[derive(Clone, Debug)]
pub(crate) struct Scan<'a> {
    data: &'a [u8],
    pos: usize,
}

impl<'a> Scan<'a> {
    pub(crate) fn new(data: &'a [u8]) -> Self {
        Self { data, pos: 0 }
    }

    pub(crate) fn pos(&self) -> usize {
        self.pos
    }

    pub(crate) fn seek(&mut self, pos: usize) {
        self.pos = pos;
    }

    #[cold]
    pub(crate) fn malformed(&self, expected: &str) -> DecodeError {
        let got = match self.data.get(self.pos) {
            Some(byte) => format!("{:?}", char::from(*byte)),
            None => "the end".to_owned(),
        };
        let detail = format!("expected {expected}, got {got}");
        DecodeError::Malformed { encoding: "json", offset: self.pos, detail }
    }

    /// Steps over white space; returns the next byte, 0 at the end.
    #[inline]
    pub(crate) fn peek(&mut self) -> u8 {
        while let Some(&byte) = self.data.get(self.pos) {
            if !matches!(byte, b' ' | b'\n' | b'\r' | b'\t') {
                return byte;
            }
            self.pos += 1;
        }
        0
    }

    /// Takes `byte` if it is next.
    #[inline]
    pub(crate) fn eat(&mut self, byte: u8) -> bool {
        let is_next = self.peek() == byte && self.pos < self.data.len();
        self.pos += usize::from(is_next);
        is_next
    }

    pub(crate) fn expect(&mut self, byte: u8, name: &str) -> Result<(), DecodeError> {
        if self.eat(byte) { Ok(()) } else { Err(self.malformed(name)) }
    }

    /// Begins an object or array that `close` ends; returns whether it has an item.
    pub(crate) fn open(&mut self, open: u8, close: u8, name: &str) -> Result<bool, DecodeError> {
        self.expect(open, name)?;
        Ok(!self.eat(close))
    }

    /// Goes on after an item; returns whether there is another.
    #[inline]
    pub(crate) fn more(&mut self, close: u8) -> Result<bool, DecodeError> {
        if self.eat(b',') {
            return Ok(true);
        }
        if self.eat(close) { Ok(false) } else { Err(self.malformed("\",\" or a closing bracket")) }
    }

    /// Reads a member's name and the colon.
    pub(crate) fn key(&mut self) -> Result<Cow<'a, str>, DecodeError> {
        let key = self.string()?;
        self.expect(b':', "\":\"")?;
        Ok(key)
    }

    /// Reads a string.
    pub(crate) fn string(&mut self) -> Result<Cow<'a, str>, DecodeError> {
        let raw = self.raw_string()?;
        if !raw.contains(&b'\\') {
            return match std::str::from_utf8(raw) {
                Ok(text) => Ok(Cow::Borrowed(text)),
                Err(_) => Err(self.malformed("UTF-8 text")),
            };
        }
        self.unescape(raw).map(Cow::Owned)
    }

    /// Returns what stands between the quotes, escapes untouched.
    fn raw_string(&mut self) -> Result<&'a [u8], DecodeError> {
        self.expect(b'"', "a string")?;
        let start = self.pos;
        while let Some(&byte) = self.data.get(self.pos) {
            match byte {
                b'"' => {
                    self.pos += 1;
                    return Ok(&self.data[start..self.pos - 1]);
                }
                b'\\' => self.pos += 2,
                _ => self.pos += 1,
            }
        }
        self.pos = self.data.len();
        Err(self.malformed("the closing quote of a string"))
    }

    fn unescape(&self, raw: &[u8]) -> Result<String, DecodeError> {
        let mut out = Vec::with_capacity(raw.len());
        let mut bytes = raw.iter().copied();
        while let Some(byte) = bytes.next() {
            if byte != b'\\' {
                out.push(byte);
                continue;
            }
            match bytes.next() {
                Some(b'n') => out.push(b'\n'),
                Some(b't') => out.push(b'\t'),
                Some(b'r') => out.push(b'\r'),
                Some(b'b') => out.push(8),
                Some(b'f') => out.push(12),
                Some(plain @ (b'"' | b'\\' | b'/')) => out.push(plain),
                Some(b'u') => {
                    let c = self.unicode(&mut bytes)?;
                    out.extend_from_slice(c.encode_utf8(&mut [0; 4]).as_bytes());
                }
                _ => return Err(self.malformed("an escape that JSON knows")),
            }
        }
        String::from_utf8(out).or_else(|_| Err(self.malformed("UTF-8 text")))
    }

    /// Reads what follows `\u`, with its second half if it is one of a pair.
    fn unicode(&self, bytes: &mut impl Iterator<Item = u8>) -> Result<char, DecodeError> {
        let mut unit = || -> Option<u32> {
            let mut value = 0;
            for _ in 0..4 {
                value = value * 16 + char::from(bytes.next()?).to_digit(16)?;
            }
            Some(value)
        };
        let Some(first) = unit() else { return Err(self.malformed("four hex digits")) };
        if !(0xd800..0xdc00).contains(&first) {
            return Ok(char::from_u32(first).unwrap_or(char::REPLACEMENT_CHARACTER));
        }
        let is_pair = bytes.next() == Some(b'\\') && bytes.next() == Some(b'u');
        let mut unit = || -> Option<u32> {
            let mut value = 0;
            for _ in 0..4 {
                value = value * 16 + char::from(bytes.next()?).to_digit(16)?;
            }
            Some(value)
        };
        match if is_pair { unit() } else { None } {
            Some(second) if (0xdc00..0xe000).contains(&second) => {
                let code = 0x1_0000 + ((first - 0xd800) << 10) + (second - 0xdc00);
                Ok(char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER))
            }
            _ => Err(self.malformed("the second half of a surrogate pair")),
        }
    }

    /// Reads a number.
    pub(crate) fn number(&mut self) -> Result<Number, DecodeError> {
        self.peek();
        for (text, value) in
            [("NaN", f64::NAN), ("Infinity", f64::INFINITY), ("-Infinity", f64::NEG_INFINITY)]
        {
            if self.literal(text) {
                return Ok(Number::F64(value));
            }
        }
        let rest = &self.data[self.pos..];
        let is_part = |b: &u8| matches!(b, b'0'..=b'9' | b'-' | b'+' | b'.' | b'e' | b'E');
        let n = rest.iter().position(|b| !is_part(b)).unwrap_or(rest.len());
        // Only ASCII was let through.
        let text = std::str::from_utf8(&rest[..n]).unwrap_or("");
        let digits = text.strip_prefix('-').unwrap_or(text);
        let is_number = digits.starts_with(|c: char| c.is_ascii_digit())
            && !(digits.starts_with('0') && digits[1..].starts_with(|c: char| c.is_ascii_digit()));
        let value = if !is_number {
            None
        } else if let Ok(value) = text.parse::<i64>() {
            Some(Number::I64(value))
        } else if let Ok(value) = text.parse::<u64>() {
            Some(Number::U64(value))
        } else {
            text.parse::<f64>().ok().map(Number::F64)
        };
        let Some(value) = value else { return Err(self.malformed("a number")) };
        self.pos += n;
        Ok(value)
    }

    /// Takes a word such as `true` if it is next.
    pub(crate) fn literal(&mut self, word: &str) -> bool {
        let is_next = self.data[self.pos.min(self.data.len())..].starts_with(word.as_bytes());
        self.pos += if is_next { word.len() } else { 0 };
        is_next
    }

    /// Steps over a value of any kind.
    pub(crate) fn skip(&mut self) -> Result<(), DecodeError> {
        // One bit per open bracket: set for an object.
        let mut open: u128 = 0;
        let mut depth = 0;
        loop {
            match self.peek() {
                byte @ (b'{' | b'[') => {
                    if depth == MAX_DEPTH {
                        return Err(self.malformed("at most 128 levels of nesting"));
                    }
                    let is_object = byte == b'{';
                    self.pos += 1;
                    open = open << 1 | u128::from(is_object);
                    depth += 1;
                    if !self.eat(if is_object { b'}' } else { b']' }) {
                        if is_object {
                            self.skip_key()?;
                        }
                        continue;
                    }
                    open >>= 1;
                    depth -= 1;
                }
                b'"' => {
                    self.raw_string()?;
                }
                b't' | b'f' | b'n' => {
                    if !(self.literal("true") || self.literal("false") || self.literal("null")) {
                        return Err(self.malformed("a value"));
                    }
                }
                _ => {
                    self.number()?;
                }
            }
            // A value has ended: go on with what is open around it.
            loop {
                if depth == 0 {
                    return Ok(());
                }
                let is_object = open & 1 == 1;
                if self.more(if is_object { b'}' } else { b']' })? {
                    if is_object {
                        self.skip_key()?;
                    }
                    break;
                }
                open >>= 1;
                depth -= 1;
            }
        }
    }

    fn skip_key(&mut self) -> Result<(), DecodeError> {
        self.raw_string()?;
        self.expect(b':', "\":\"")
    }

    /// Checks that nothing but white space, or the zero some writers add, follows.
    pub(crate) fn end(&mut self) -> Result<(), DecodeError> {
        self.peek();
        if self.data[self.pos.min(self.data.len())..].iter().all(|b| *b == 0) {
            Ok(())
        } else {
            Err(self.malformed("the end of the message"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_skip(text: &str, ok: bool) {
        let mut scan = Scan::new(text.as_bytes());
        assert_eq!(scan.skip().and_then(|()| scan.end()).is_ok(), ok, "{text}");
        let strict = serde_json::from_str::<serde_json::Value>(text).is_ok();
        assert!(!strict || ok, "serde_json accepts {text}");
    }

    #[test]
    fn values_are_stepped_over() {
        check_skip(r#"{"a": [1, 2.5e-3, {"b": "x\"]}"}], "c": null, "d": true} "#, true);
        check_skip("[]", true);
        check_skip("{}", true);
        check_skip("[[], {}, [{}]]", true);
        check_skip("[NaN, -Infinity]", true);
        check_skip("\"\\ud83d\\ude00\"", true);
        check_skip("[1,]", false);
        check_skip("{\"a\" 1}", false);
        check_skip("[1", false);
        check_skip("\"abc", false);
        check_skip("\"abc\\", false);
        check_skip("01", false);
        check_skip("", false);
        check_skip("1 2", false);
        check_skip("[1}", false);
        check_skip(&"[".repeat(200), false);
    }

    #[test]
    fn strings_are_unescaped() {
        let text = r#""a\n\t\"\\\/\u00e9\ud83d\ude00z""#;
        let expected: String = serde_json::from_str(text).unwrap();
        assert_eq!(Scan::new(text.as_bytes()).string().unwrap(), expected);
        for bad in [r#""\ud83d""#, r#""\u12""#, r#""\x""#] {
            Scan::new(bad.as_bytes()).string().unwrap_err();
        }
    }

    #[test]
    fn numbers_keep_their_kind() {
        let read = |text: &str| Scan::new(text.as_bytes()).number().unwrap();
        assert!(matches!(read("-5"), Number::I64(-5)));
        assert!(matches!(read("18446744073709551615"), Number::U64(u64::MAX)));
        assert!(matches!(read("0.1"), Number::F64(v) if v.to_bits() == 0.1_f64.to_bits()));
        assert!(matches!(read("1e400"), Number::F64(v) if v.is_infinite()));
    }
}
