//! Text to conditions.

use super::{ConditionError, EpisodeValue, MAX_DEPTH, Node, Operand, Operator};

#[derive(Debug, Clone, PartialEq)]
enum Token {
    Word(String),
    /// A name in backticks: never a key word.
    Quoted(String),
    Text(String),
    Number(f64),
    Sign(&'static str),
}

struct Parser<'a> {
    text: &'a str,
    tokens: Vec<(usize, Token)>,
    next: usize,
    depth: usize,
}

pub(super) fn parse(text: &str) -> Result<Node, ConditionError> {
    let mut parser = Parser { text, tokens: tokens(text)?, next: 0, depth: 0 };
    let node = parser.or()?;
    match parser.peek() {
        None => Ok(node),
        Some(_) => Err(parser.error("and, or, a comparison, or the end")),
    }
}

const SIGNS: [&str; 12] = ["==", "!=", "<=", ">=", "<", ">", "~", "(", ")", "[", "]", ","];

fn tokens(text: &str) -> Result<Vec<(usize, Token)>, ConditionError> {
    let mut tokens = Vec::new();
    let mut at = 0;
    while let Some(c) = text[at..].chars().next() {
        let rest = &text[at..];
        if c.is_whitespace() {
            at += c.len_utf8();
            continue;
        }
        let is_value_before = matches!(
            tokens.last(),
            Some((_, Token::Word(_) | Token::Quoted(_) | Token::Number(_) | Token::Sign(")" | "]")))
        );
        if let Some(sign) = SIGNS.into_iter().find(|sign| rest.starts_with(sign)) {
            tokens.push((at, Token::Sign(sign)));
            at += sign.len();
        } else if matches!(c, '\'' | '"' | '`') {
            let Some(end) = rest[1..].find(c) else {
                return Err(error_at(text, at, "a closing quote", "none".to_owned()));
            };
            let inner = rest[1..=end].to_owned();
            tokens.push((at, if c == '`' { Token::Quoted(inner) } else { Token::Text(inner) }));
            at += end + 2;
        } else if c.is_ascii_digit() || (matches!(c, '-' | '+' | '.') && !is_value_before) {
            let length = number_length(rest);
            let number: Result<f64, _> = rest[..length].parse();
            match number {
                Ok(number) if number.is_finite() => tokens.push((at, Token::Number(number))),
                _ => return Err(error_at(text, at, "a number", format!("{:?}", &rest[..length.max(1)]))),
            }
            at += length;
        } else if is_word(c) {
            let length = word_length(rest);
            tokens.push((at, Token::Word(rest[..length].to_owned())));
            at += length;
        } else {
            let expected = if c == '=' {
                "\"==\" for equality"
            } else {
                "a name, a number, a text in quotes or an operator"
            };
            return Err(error_at(text, at, expected, format!("the unexpected {c:?}")));
        }
    }
    Ok(tokens)
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || matches!(c, '_' | '.' | '/' | '@')
}

/// Returns the length of a name; a dim in brackets belongs to it: `action[3]`.
fn word_length(text: &str) -> usize {
    let mut length = text.find(|c| !is_word(c)).unwrap_or(text.len());
    let rest = &text[length..];
    if let Some(end) = rest.strip_prefix('[').and_then(|inner| inner.find(']')) {
        let inner = &rest[1..=end];
        if !inner.is_empty() && inner.bytes().all(|b| b.is_ascii_digit()) {
            length += end + 2;
        }
    }
    length
}

fn number_length(text: &str) -> usize {
    let bytes = text.as_bytes();
    let mut end = usize::from(matches!(bytes[0], b'-' | b'+'));
    while end < bytes.len() {
        let is_exponent_sign = matches!(bytes[end], b'-' | b'+') && matches!(bytes[end - 1], b'e' | b'E');
        let is_exponent = matches!(bytes[end], b'e' | b'E')
            && bytes.get(end + 1).is_some_and(|b| b.is_ascii_digit() || matches!(b, b'-' | b'+'));
        if !(bytes[end].is_ascii_digit()
            || bytes[end] == b'.'
            || is_exponent
            || (end > 0 && is_exponent_sign))
        {
            break;
        }
        end += 1;
    }
    end
}

fn error_at(text: &str, at: usize, expected: &'static str, got: String) -> ConditionError {
    let column = text[..at].chars().count() + 1;
    let near: String = text[at..].chars().take(24).collect();
    let place =
        if near.is_empty() { format!("column {column}") } else { format!("column {column} ({near})") };
    ConditionError::Syntax { place, expected, got }
}

impl Parser<'_> {
    fn peek(&self) -> Option<&Token> {
        self.tokens.get(self.next).map(|(_, token)| token)
    }

    fn error(&self, expected: &'static str) -> ConditionError {
        match self.tokens.get(self.next) {
            None => error_at(self.text, self.text.len(), expected, "the end".to_owned()),
            Some((at, token)) => {
                let got = match token {
                    Token::Word(word) => format!("{word:?}"),
                    Token::Quoted(name) => format!("`{name}`"),
                    Token::Text(text) => format!("the text {text:?}"),
                    Token::Number(number) => format!("the number {number}"),
                    Token::Sign(sign) => format!("{sign:?}"),
                };
                error_at(self.text, *at, expected, got)
            }
        }
    }

    fn is_keyword(&self, keyword: &str) -> bool {
        matches!(self.peek(), Some(Token::Word(word)) if word.eq_ignore_ascii_case(keyword))
    }

    fn takes_keyword(&mut self, keyword: &str) -> bool {
        let is_there = self.is_keyword(keyword);
        self.next += usize::from(is_there);
        is_there
    }

    fn takes_sign(&mut self, sign: &'static str) -> bool {
        let is_there = self.peek() == Some(&Token::Sign(sign));
        self.next += usize::from(is_there);
        is_there
    }

    fn or(&mut self) -> Result<Node, ConditionError> {
        let mut parts = vec![self.and()?];
        while self.takes_keyword("or") {
            parts.push(self.and()?);
        }
        Ok(if parts.len() == 1 { parts.remove(0) } else { Node::Or(parts) })
    }

    fn and(&mut self) -> Result<Node, ConditionError> {
        let mut parts = vec![self.not()?];
        while self.takes_keyword("and") {
            parts.push(self.not()?);
        }
        Ok(if parts.len() == 1 { parts.remove(0) } else { Node::And(parts) })
    }

    fn not(&mut self) -> Result<Node, ConditionError> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(ConditionError::TooLarge { what: "deep", max: MAX_DEPTH });
        }
        let node = if self.takes_keyword("not") {
            Node::Not(Box::new(self.not()?))
        } else if self.takes_sign("(") {
            let inner = self.or()?;
            if !self.takes_sign(")") {
                return Err(self.error("\")\""));
            }
            inner
        } else {
            self.comparison()?
        };
        self.depth -= 1;
        Ok(node)
    }

    fn comparison(&mut self) -> Result<Node, ConditionError> {
        let left = self.operand()?;
        if self.takes_keyword("in") {
            return Ok(Node::In(left, self.list()?));
        }
        let operators = [
            ("==", Operator::Equal),
            ("!=", Operator::NotEqual),
            ("<=", Operator::LessOrEqual),
            (">=", Operator::GreaterOrEqual),
            ("<", Operator::Less),
            (">", Operator::Greater),
            ("~", Operator::Contains),
        ];
        match operators.into_iter().find(|(sign, _)| self.takes_sign(sign)) {
            Some((_, operator)) => Ok(Node::Compare(left, operator, self.operand()?)),
            None => Ok(Node::Value(left)),
        }
    }

    fn list(&mut self) -> Result<Vec<EpisodeValue>, ConditionError> {
        if !self.takes_sign("[") {
            return Err(self.error("\"[\" and a list of values"));
        }
        let mut values = Vec::new();
        loop {
            match self.operand()? {
                Operand::Literal(value) => values.push(value),
                Operand::Name(_) => {
                    self.next -= 1;
                    return Err(self.error("a number or a text in quotes"));
                }
            }
            if self.takes_sign("]") {
                return Ok(values);
            }
            if !self.takes_sign(",") {
                return Err(self.error("\",\" or \"]\""));
            }
        }
    }

    fn operand(&mut self) -> Result<Operand, ConditionError> {
        let expected = "a name, a number or a text in quotes";
        let Some(token) = self.peek().cloned() else { return Err(self.error(expected)) };
        let operand = match token {
            Token::Number(number) => Operand::Literal(EpisodeValue::Number(number)),
            Token::Text(text) => Operand::Literal(EpisodeValue::Text(text)),
            Token::Quoted(name) => Operand::Name(name),
            Token::Sign(_) => return Err(self.error(expected)),
            Token::Word(word) => match word.to_ascii_lowercase().as_str() {
                "true" => Operand::Literal(EpisodeValue::Bool(true)),
                "false" => Operand::Literal(EpisodeValue::Bool(false)),
                "null" => Operand::Literal(EpisodeValue::Null),
                "and" | "or" | "not" | "in" => return Err(self.error(expected)),
                _ => {
                    self.next += 1;
                    return self.named(word);
                }
            },
        };
        self.next += 1;
        Ok(operand)
    }

    /// Takes what follows a name: the argument of a statistic.
    fn named(&mut self, word: String) -> Result<Operand, ConditionError> {
        if !self.takes_sign("(") {
            return Ok(Operand::Name(word));
        }
        let argument = match self.peek().cloned() {
            Some(Token::Word(name) | Token::Quoted(name)) => name,
            _ => return Err(self.error("the name of a column or dim")),
        };
        self.next += 1;
        if !self.takes_sign(")") {
            return Err(self.error("\")\""));
        }
        Ok(Operand::Name(format!("{word}({argument})")))
    }
}
