//! The language of `--where`: conditions over the columns and statistics of episodes.
//!
//! ```text
//! condition  = and ("or" and)*
//! and        = not ("and" not)*
//! not        = "not" not | "(" condition ")" | comparison
//! comparison = value [("==" | "!=" | "<" | "<=" | ">" | ">=" | "~") value] | value "in" "[" literal, ... "]"
//! value      = literal | name | statistic "(" name ")"
//! literal    = 12 | -0.5 | 'text' | "text" | true | false | null
//! name       = letters, digits and . _ / [ ] @ | `any text`
//! ```
//!
//! `~` asks whether a text contains another one, whatever the case. What is unknown (null) makes a comparison unknown,
//! and only what is certainly true is taken; `x == null` asks whether x is unknown.

mod parse;

use std::collections::BTreeMap;

use thiserror::Error;

/// Longest condition, in bytes.
const MAX_LENGTH: usize = 64 << 10;
/// Deepest nesting.
const MAX_DEPTH: usize = 64;

/// Why a condition cannot be understood or evaluated.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum ConditionError {
    /// The text does not follow the grammar.
    #[error("in --where, at {place}: expected {expected}, got {got}")]
    Syntax {
        /// Position and the text there.
        place: String,
        /// What the grammar has there.
        expected: &'static str,
        /// What was found.
        got: String,
    },
    /// The condition is too long or nested too deep.
    #[error("--where is too {what}: expected at most {max}")]
    TooLarge {
        /// Long or deep.
        what: &'static str,
        /// The bound.
        max: usize,
    },
    /// A name stands for nothing.
    #[error("in --where: unknown name {name:?}{}; {}", suggestion(.near), listed(.known))]
    UnknownName {
        /// The name.
        name: String,
        /// The most similar known one.
        near: Option<String>,
        /// All known names.
        known: Vec<String>,
    },
    /// Two values cannot be compared.
    #[error("in --where: {left} is {left_type} and {right} is {right_type}; expected two numbers or two texts{}", if *.is_quotable { " (texts stand in quotes)" } else { "" })]
    Types {
        /// The left side.
        left: String,
        /// Its type.
        left_type: &'static str,
        /// The right side.
        right: String,
        /// Its type.
        right_type: &'static str,
        /// Whether quotes would help.
        is_quotable: bool,
    },
    /// A value that is neither true nor false stands where a condition should.
    #[error("in --where: {value} is {got}, expected true or false; compare it with something")]
    NotACondition {
        /// The value as written.
        value: String,
        /// Its type.
        got: &'static str,
    },
}

fn suggestion(near: &Option<String>) -> String {
    near.as_ref().map_or(String::new(), |near| format!(" (did you mean {near:?}?)"))
}

/// Names the plain names; statistics of dims are too many for a message.
fn listed(known: &[String]) -> String {
    let plain: Vec<&str> = known.iter().map(String::as_str).filter(|name| !name.contains('(')).collect();
    let has_statistics = plain.len() < known.len();
    let rest = if has_statistics { ", and statistics such as mean(action[0])" } else { "" };
    format!("there are: {}{rest}; --list-names shows all with their values", plain.join(", "))
}

/// A value of an episode.
#[derive(Debug, Clone, PartialEq)]
pub enum EpisodeValue {
    /// Unknown.
    Null,
    /// A truth value.
    Bool(bool),
    /// A number.
    Number(f64),
    /// A text.
    Text(String),
}

impl EpisodeValue {
    fn type_name(&self) -> &'static str {
        match self {
            EpisodeValue::Null => "unknown",
            EpisodeValue::Bool(_) => "true or false",
            EpisodeValue::Number(_) => "a number",
            EpisodeValue::Text(_) => "a text",
        }
    }
}

/// A parsed condition.
#[derive(Debug, Clone, PartialEq)]
pub struct Condition {
    root: Node,
}

#[derive(Debug, Clone, PartialEq)]
enum Node {
    Or(Vec<Node>),
    And(Vec<Node>),
    Not(Box<Node>),
    Compare(Operand, Operator, Operand),
    In(Operand, Vec<EpisodeValue>),
    Value(Operand),
}

#[derive(Debug, Clone, PartialEq)]
enum Operand {
    Literal(EpisodeValue),
    /// A name, or a statistic of one as `statistic(name)`.
    Name(String),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Operator {
    Equal,
    NotEqual,
    Less,
    LessOrEqual,
    Greater,
    GreaterOrEqual,
    Contains,
}

impl Condition {
    /// Parses a condition.
    ///
    /// # Errors
    /// The text does not follow the grammar, or is too long or nested too deep.
    pub fn parse(text: &str) -> Result<Condition, ConditionError> {
        if text.len() > MAX_LENGTH {
            return Err(ConditionError::TooLarge { what: "long", max: MAX_LENGTH });
        }
        parse::parse(text).map(|root| Condition { root })
    }

    /// Returns whether a name is asked for.
    pub fn mentions(&self, name: impl Fn(&str) -> bool) -> bool {
        self.names().iter().any(|n| name(n))
    }

    /// Returns all names that are asked for.
    pub fn names(&self) -> Vec<&str> {
        let mut names = Vec::new();
        collect(&self.root, &mut names);
        names
    }

    /// Returns whether the condition is certainly true of an episode.
    ///
    /// # Errors
    /// A name is unknown, or values of different types are compared.
    pub fn holds(&self, episode: &BTreeMap<String, EpisodeValue>) -> Result<bool, ConditionError> {
        Ok(truth(&self.root, episode)? == Some(true))
    }
}

fn collect<'a>(node: &'a Node, names: &mut Vec<&'a str>) {
    let mut operand = |operand: &'a Operand| {
        if let Operand::Name(name) = operand {
            names.push(name);
        }
    };
    match node {
        Node::Or(parts) | Node::And(parts) => parts.iter().for_each(|part| collect(part, names)),
        Node::Not(inner) => collect(inner, names),
        Node::Compare(left, _, right) => {
            operand(left);
            operand(right);
        }
        Node::In(value, _) | Node::Value(value) => operand(value),
    }
}

/// Returns the truth of a node; `None` where it depends on something unknown.
fn truth(node: &Node, episode: &BTreeMap<String, EpisodeValue>) -> Result<Option<bool>, ConditionError> {
    match node {
        Node::Not(inner) => Ok(truth(inner, episode)?.map(|t| !t)),
        Node::Or(parts) => joined(parts, episode, true),
        Node::And(parts) => joined(parts, episode, false),
        Node::Value(operand) => match value(operand, episode)? {
            EpisodeValue::Bool(t) => Ok(Some(t)),
            EpisodeValue::Null => Ok(None),
            other => Err(ConditionError::NotACondition { value: shown(operand), got: other.type_name() }),
        },
        Node::In(operand, list) => {
            let left = value(operand, episode)?;
            let mut found = Some(false);
            for literal in list {
                let right = Operand::Literal(literal.clone());
                match compared(&left, operand, Operator::Equal, literal, &right)? {
                    Some(true) => return Ok(Some(true)),
                    None => found = None,
                    Some(false) => {}
                }
            }
            Ok(found)
        }
        Node::Compare(left, operator, right) => {
            compared(&value(left, episode)?, left, *operator, &value(right, episode)?, right)
        }
    }
}

/// Joins parts of which one with the truth `decides` decides; all are evaluated, so that errors do not hide.
fn joined(
    parts: &[Node],
    episode: &BTreeMap<String, EpisodeValue>,
    decides: bool,
) -> Result<Option<bool>, ConditionError> {
    let mut all = Some(!decides);
    for part in parts {
        match truth(part, episode)? {
            Some(t) if t == decides => all = Some(decides),
            None if all != Some(decides) => all = None,
            _ => {}
        }
    }
    Ok(all)
}

fn value(
    operand: &Operand,
    episode: &BTreeMap<String, EpisodeValue>,
) -> Result<EpisodeValue, ConditionError> {
    let name = match operand {
        Operand::Literal(value) => return Ok(value.clone()),
        Operand::Name(name) => name,
    };
    if let Some(value) = episode.get(name) {
        return Ok(value.clone());
    }
    let mut known: Vec<String> = episode.keys().cloned().collect();
    let near = nearest(name, &known);
    // Of the many statistics one function is enough to show the columns.
    known.retain(|n| !n.contains('(') || n.starts_with("mean("));
    Err(ConditionError::UnknownName { name: name.clone(), near, known })
}

fn compared(
    left: &EpisodeValue,
    left_operand: &Operand,
    operator: Operator,
    right: &EpisodeValue,
    right_operand: &Operand,
) -> Result<Option<bool>, ConditionError> {
    use EpisodeValue::{Bool, Null, Number, Text};
    let is_null_asked =
        [left_operand, right_operand].iter().any(|operand| **operand == Operand::Literal(Null));
    let order = match (left, right) {
        (Null, Null) if is_null_asked => Some(std::cmp::Ordering::Equal),
        (Null, _) | (_, Null) if is_null_asked => {
            return Ok(match operator {
                Operator::Equal => Some(false),
                Operator::NotEqual => Some(true),
                _ => None,
            });
        }
        (Null, _) | (_, Null) => return Ok(None),
        (Text(a), Text(b)) if operator == Operator::Contains => {
            return Ok(Some(a.to_lowercase().contains(&b.to_lowercase())));
        }
        (Number(a), Number(b)) => a.partial_cmp(b),
        (Text(a), Text(b)) => Some(a.cmp(b)),
        (Bool(a), Bool(b)) => Some(a.cmp(b)),
        _ => {
            let is_name = |operand: &Operand| matches!(operand, Operand::Name(_));
            return Err(ConditionError::Types {
                left: shown(left_operand),
                left_type: left.type_name(),
                right: shown(right_operand),
                right_type: right.type_name(),
                is_quotable: is_name(left_operand) != is_name(right_operand)
                    && [left, right].iter().any(|v| matches!(v, Text(_))),
            });
        }
    };
    if operator == Operator::Contains {
        return Err(ConditionError::Types {
            left: shown(left_operand),
            left_type: left.type_name(),
            right: shown(right_operand),
            right_type: right.type_name(),
            is_quotable: true,
        });
    }
    Ok(order.map(|order| match operator {
        Operator::Equal => order.is_eq(),
        Operator::NotEqual => order.is_ne(),
        Operator::Less => order.is_lt(),
        Operator::LessOrEqual => order.is_le(),
        Operator::Greater => order.is_gt(),
        Operator::GreaterOrEqual | Operator::Contains => order.is_ge(),
    }))
}

fn shown(operand: &Operand) -> String {
    match operand {
        Operand::Name(name) => name.clone(),
        Operand::Literal(EpisodeValue::Text(text)) => format!("{text:?}"),
        Operand::Literal(EpisodeValue::Number(number)) => number.to_string(),
        Operand::Literal(EpisodeValue::Bool(t)) => t.to_string(),
        Operand::Literal(EpisodeValue::Null) => "null".to_owned(),
    }
}

/// Returns the known name that takes the fewest changes, if they are few.
fn nearest(name: &str, known: &[String]) -> Option<String> {
    let scored = known.iter().map(|other| (distance(name, other), other));
    let (changes, best) = scored.min_by_key(|(changes, _)| *changes)?;
    (changes <= 2.max(name.chars().count() / 3)).then(|| best.clone())
}

/// Returns the number of insertions, deletions and replacements between two texts.
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().take(200).collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.chars().take(200).enumerate() {
        let mut corner = i;
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let above = row[j + 1];
            row[j + 1] = (corner + usize::from(x != *y)).min(above + 1).min(row[j] + 1);
            corner = above;
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn episode() -> BTreeMap<String, EpisodeValue> {
        let text = |t: &str| EpisodeValue::Text(t.to_owned());
        [
            ("length", EpisodeValue::Number(120.0)),
            ("success", EpisodeValue::Bool(true)),
            ("rated", EpisodeValue::Null),
            ("task", text("Pick the red cube")),
            ("session", text("s-1")),
            ("mean(action.elbow)", EpisodeValue::Number(-0.25)),
            ("odd name", EpisodeValue::Number(1.0)),
        ]
        .into_iter()
        .map(|(name, value)| (name.to_owned(), value))
        .collect()
    }

    fn check(condition: &str, expected: bool) {
        let got = Condition::parse(condition).and_then(|c| c.holds(&episode()));
        assert_eq!(got, Ok(expected), "{condition}");
    }

    fn check_error(condition: &str, part: &str) {
        let got = Condition::parse(condition).and_then(|c| c.holds(&episode()));
        let text = got.expect_err(condition).to_string();
        assert!(text.contains(part), "{condition}: {text}");
    }

    #[test]
    fn conditions_hold_or_not() {
        check("length > 100", true);
        check("length>100and length<=120", true);
        check("100 >= length", false);
        check("success", true);
        check("not success or length == 1.2e2", true);
        check("not (success and length < 130)", false);
        check("task ~ 'RED'", true);
        check("session == \"s-1\"", true);
        check("session in ['s-0', 's-1']", true);
        check("length in [1, 2]", false);
        check("mean(action.elbow) < -0.2", true);
        check("`odd name` == 1", true);
        check("success == true and session != 's-2'", true);
        check("NOT success OR task ~ 'cube' AND length != -3", true);
    }

    #[test]
    fn what_is_unknown_is_not_taken() {
        check("rated", false);
        check("not rated", false);
        check("rated or success", true);
        check("rated > 3", false);
        check("not (rated > 3)", false);
        check("rated == null", true);
        check("rated != null", false);
        check("length == null", false);
        check("length != null", true);
    }

    #[test]
    fn errors_help() {
        check_error("lenght > 3", "did you mean \"length\"?");
        check_error("whatever_this_is > 3", "there are: length");
        check_error("length > 'a'", "length is a number and \"a\" is a text");
        check_error("session == 3", "texts stand in quotes");
        check_error("session == s-1", "unexpected");
        check_error("length", "expected true or false");
        check_error("length >", "got the end");
        check_error("(length > 3", "\")\"");
        check_error("length = 3", "\"==\"");
        check_error("'open", "closing quote");
        check_error("length > 3 success", "and, or");
        check_error("", "got the end");
        check_error("median(action) > 3", "unknown name");
        check_error("success ~ true", "expected two numbers or two texts");
        check_error(&"(".repeat(100_000), "too long");
        check_error(&"not ".repeat(1000), "too deep");
        check_error(&"(".repeat(1000), "too deep");
    }
}
