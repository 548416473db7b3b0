//! Values within decoded messages.

use serde_json::Value;

use crate::contract::MarkerValue;
use crate::decode::{FieldPath, Segment};

/// Returns the value at a path of a decoded message; where a text stands on the way, the JSON that it holds is entered.
pub fn value_at(message: &Value, path: &str) -> Option<Value> {
    let path = path.parse::<FieldPath>().ok()?;
    let mut at = message.clone();
    for segment in path.segments() {
        if let Value::String(text) = &at {
            at = serde_json::from_str(text).ok()?;
        }
        at = match segment {
            Segment::Field(name) => at.get(name)?.clone(),
            Segment::Index(index) => {
                let items = at.as_array()?;
                let index = if *index < 0 { items.len() as i64 + index } else { *index };
                items.get(usize::try_from(index).ok()?)?.clone()
            }
            Segment::Key { member, value } => {
                let found = at.as_array()?.iter().find(|item| {
                    let name = member.iter().try_fold(*item, |item, name| item.get(name));
                    name.and_then(Value::as_str) == Some(value)
                });
                found?.clone()
            }
            Segment::Slice { .. } => return None,
        };
    }
    Some(at)
}

/// Returns whether a value is what a marker asks for; texts may have `*` and `?`.
pub fn matches(expected: &MarkerValue, value: &Value) -> bool {
    match expected {
        MarkerValue::AnyOf(any) => any.iter().any(|expected| matches(expected, value)),
        MarkerValue::Bool(expected) => match value {
            Value::Bool(got) => got == expected,
            Value::Number(got) => got.as_f64().is_some_and(|got| (got != 0.0) == *expected),
            Value::String(got) => got.eq_ignore_ascii_case(if *expected { "true" } else { "false" }),
            _ => false,
        },
        MarkerValue::Integer(expected) => match value {
            Value::Number(got) => got.as_f64() == Some(*expected as f64),
            Value::String(got) => got.trim().parse() == Ok(*expected),
            _ => false,
        },
        MarkerValue::Text(expected) => match value {
            Value::String(got) => {
                let pattern = crate::contract::TopicPattern::new(expected);
                got == expected || pattern.is_glob() && pattern.captures(got).is_some()
            }
            _ => false,
        },
    }
}

/// Returns a value as the text of a label.
pub(crate) fn text_of(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Null => String::new(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn paths_go_on_into_texts_that_hold_json() {
        let message = json!({"data": "{\"event\": \"start\", \"items\": [1, {\"n\": \"a\", \"v\": 2}]}"});
        assert_eq!(value_at(&message, "data.event"), Some(json!("start")));
        assert_eq!(value_at(&message, "data.items[0]"), Some(json!(1)));
        assert_eq!(value_at(&message, "data.items[-1].v"), Some(json!(2)));
        assert_eq!(value_at(&message, "data.items[n=\"a\"].v"), Some(json!(2)));
        assert_eq!(value_at(&message, "data.none"), None);
    }

    #[test]
    fn markers_match_by_type() {
        assert!(matches(&MarkerValue::Bool(true), &json!(true)));
        assert!(matches(&MarkerValue::Bool(true), &json!(1)));
        assert!(!matches(&MarkerValue::Bool(true), &json!(false)));
        assert!(matches(&MarkerValue::Text("st*".to_owned()), &json!("start")));
        assert!(!matches(&MarkerValue::Text("st".to_owned()), &json!("start")));
        assert!(matches(&MarkerValue::Integer(3), &json!(3.0)));
        let any = MarkerValue::AnyOf(vec![MarkerValue::Integer(1), MarkerValue::Text("go".to_owned())]);
        assert!(matches(&any, &json!("go")));
    }
}
