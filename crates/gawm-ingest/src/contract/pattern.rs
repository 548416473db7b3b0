//! Topic patterns.

use regex::Regex;

/// A topic, exact or with wildcards.
#[derive(Debug, Clone)]
pub struct TopicPattern {
    text: String,
    regex: Option<Regex>,
}

impl PartialEq for TopicPattern {
    fn eq(&self, other: &Self) -> bool {
        self.text == other.text
    }
}

impl TopicPattern {
    /// Reads a pattern: `*` is any text without `/`, `**` any text, `?` one character; all else is literal.
    pub fn new(text: &str) -> Self {
        let regex = text.contains(['*', '?']).then(|| {
            let mut pattern = String::from("^");
            let mut chars = text.chars().peekable();
            while let Some(char) = chars.next() {
                match char {
                    '*' if chars.next_if_eq(&'*').is_some() => pattern.push_str("(.*)"),
                    '*' => pattern.push_str("([^/]*)"),
                    '?' => pattern.push_str("([^/])"),
                    _ => pattern.push_str(&regex::escape(char.encode_utf8(&mut [0; 4]))),
                }
            }
            pattern.push('$');
            Regex::new(&pattern).expect("escaped text and fixed groups are a valid expression")
        });
        Self { text: text.to_owned(), regex }
    }

    /// Returns the pattern as written.
    pub fn as_str(&self) -> &str {
        &self.text
    }

    /// Returns whether it has wildcards.
    pub fn is_glob(&self) -> bool {
        self.regex.is_some()
    }

    /// Returns what the wildcards matched, in order, or `None` when the topic does not match.
    pub fn captures(&self, topic: &str) -> Option<Vec<String>> {
        match &self.regex {
            None => (self.text == topic).then(Vec::new),
            Some(regex) => regex.captures(topic).map(|found| {
                found.iter().skip(1).flatten().map(|group| group.as_str().to_owned()).collect()
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_captures(pattern: &str, topic: &str, expected: Option<&[&str]>) {
        let got = TopicPattern::new(pattern).captures(topic);
        let expected = expected.map(|texts| texts.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>());
        assert_eq!(got, expected, "{pattern} on {topic}");
    }

    #[test]
    fn matches_topics() {
        check_captures("/a/b", "/a/b", Some(&[]));
        check_captures("/a/b", "/a/bc", None);
        check_captures("/cam/*/image", "/cam/left/image", Some(&["left"]));
        check_captures("/cam/*/image", "/cam/left/raw/image", None);
        check_captures("/cam/**/image", "/cam/left/raw/image", Some(&["left/raw"]));
        check_captures("/joint?", "/joint7", Some(&["7"]));
        check_captures("/a.b(c)*", "/a.b(c)d", Some(&["d"]));
    }
}
