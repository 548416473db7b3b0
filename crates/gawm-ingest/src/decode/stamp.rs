//! Stamps inside messages: when the sensor says the sample was taken.

use serde_json::Value;

use super::resolve::{NANOS, SECONDS};
use super::row::Number;

/// Wall-clock stamps lie between these two; others are simulated or since boot. 1990-01-01 and 2100-01-01.
const WALL_CLOCK_NS: std::ops::Range<i64> = 631_152_000_000_000_000..4_102_444_800_000_000_000;

const NS_PER_S: i64 = 1_000_000_000;

/// What kind of clock a stamp seems to come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum StampClass {
    /// Between the years 1990 and 2100.
    WallClock,
    /// Outside them: simulated time, time since boot, or garbage.
    Other,
}

/// Classifies a stamp in nanoseconds.
pub fn classify_stamp(stamp_ns: i64) -> StampClass {
    if WALL_CLOCK_NS.contains(&stamp_ns) { StampClass::WallClock } else { StampClass::Other }
}

/// Unit of a stamp that is one number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum StampUnit {
    /// Seconds.
    Seconds,
    /// Milliseconds.
    Milliseconds,
    /// Microseconds.
    Microseconds,
    /// Nanoseconds.
    Nanoseconds,
    /// The unit that makes it a wall-clock time; numbers for which none does are no stamp.
    Auto,
}

/// The parts of one message's stamp, as they are found.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Stamp {
    parts: [Option<Number>; 2],
    text_ns: Option<i64>,
}

/// What the parts mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StampForm {
    /// The message has no stamp.
    None,
    /// Part 0 is seconds, part 1 nanoseconds; or part 0 alone is one number or a text.
    Parts(StampUnit),
}

impl Stamp {
    #[inline]
    pub(crate) fn number(&mut self, part: usize, value: Number) {
        if let Some(cell) = self.parts.get_mut(part) {
            *cell = Some(value);
        }
    }

    pub(crate) fn text(&mut self, text: &str) {
        self.text_ns = parse_iso8601(text);
    }

    /// Returns the stamp in nanoseconds; `None` if absent, 0 or beyond what `i64` holds.
    #[inline]
    pub(crate) fn finish(&self, form: StampForm) -> Option<i64> {
        let StampForm::Parts(unit) = form else { return None };
        let stamp = match (self.parts, self.text_ns) {
            ([Some(seconds), Some(nanos)], _) => {
                let seconds = integer(seconds)?;
                seconds.checked_mul(NS_PER_S)?.checked_add(integer(nanos)?)
            }
            ([Some(value), None], _) => scaled(value, unit),
            (_, text_ns) => text_ns,
        };
        stamp.filter(|ns| *ns != 0)
    }
}

/// Returns the time that a value of a decoded message states: seconds and nanoseconds, a number of any unit, or a text.
///
/// A number that is no wall-clock time in any unit counts seconds, of a simulation for one.
pub(crate) fn stamp_of_json(value: &Value) -> Option<i64> {
    let number = |value: &Value| {
        let whole = value.as_i64().map(Number::I64);
        whole.or_else(|| value.as_f64().map(Number::F64))
    };
    match value {
        Value::Number(_) => {
            let number = number(value)?;
            scaled(number, StampUnit::Auto).or_else(|| scaled(number, StampUnit::Seconds))
        }
        Value::String(text) => parse_iso8601(text),
        Value::Object(parts) => {
            let part = |names: &[&str]| names.iter().find_map(|name| integer(number(parts.get(*name)?)?));
            let nanos = part(&NANOS).unwrap_or(0);
            part(&SECONDS)?.checked_mul(NS_PER_S)?.checked_add(nanos)
        }
        _ => None,
    }
}

fn integer(number: Number) -> Option<i64> {
    match number {
        Number::I64(v) => Some(v),
        Number::U64(v) => i64::try_from(v).ok(),
        Number::F64(v) if v.fract() == 0.0 && v.abs() < 9e18 => Some(v as i64),
        Number::F64(_) | Number::Bool(_) => None,
    }
}

fn scaled(number: Number, unit: StampUnit) -> Option<i64> {
    let factor = match unit {
        StampUnit::Seconds => NS_PER_S,
        StampUnit::Milliseconds => 1_000_000,
        StampUnit::Microseconds => 1_000,
        StampUnit::Nanoseconds => 1,
        StampUnit::Auto => {
            // The ranges of the four units do not touch: 1990..2100 spans less than a factor of 7.
            return [
                StampUnit::Seconds,
                StampUnit::Milliseconds,
                StampUnit::Microseconds,
                StampUnit::Nanoseconds,
            ]
            .into_iter()
            .filter_map(|unit| scaled(number, unit))
            .find(|ns| WALL_CLOCK_NS.contains(ns));
        }
    };
    if let Some(value) = integer(number) {
        return value.checked_mul(factor);
    }
    let Number::F64(value) = number else { return None };
    float_to_ns(value, factor)
}

/// Rounds to whole nanoseconds; the whole part is scaled as an integer, so that it is exact.
fn float_to_ns(value: f64, factor: i64) -> Option<i64> {
    if !value.is_finite() || value.abs() > 9e18 {
        return None;
    }
    let whole = value.trunc();
    let rest = ((value - whole) * factor as f64).round() as i64;
    (whole as i64).checked_mul(factor)?.checked_add(rest)
}

/// Parses `2024-05-01T12:00:00.123456789Z`, with `+hh:mm` in place of `Z`, or without a zone (taken as UTC).
pub(crate) fn parse_iso8601(text: &str) -> Option<i64> {
    let (date, rest) = text.trim().split_once(['T', 't', ' '])?;
    let mut date = date.splitn(3, '-').map(|part| part.parse::<i64>().ok());
    let (year, month, day) = (date.next()??, date.next()??, date.next()??);
    if !(1..=9999).contains(&year) || !(1..=12).contains(&month) || !(1..=31).contains(&day) {
        return None;
    }
    let (clock, offset_s) = split_zone(rest)?;
    let (clock, fraction) = clock.split_once(['.', ',']).unwrap_or((clock, ""));
    let mut clock = clock.splitn(3, ':').map(|part| part.parse::<i64>().ok());
    let (hour, minute, second) = (clock.next()??, clock.next()??, clock.next().flatten().unwrap_or(0));
    if !(0..24).contains(&hour) || !(0..60).contains(&minute) || !(0..=60).contains(&second) {
        return None;
    }
    let seconds = days_from_civil(year, month, day) * 86_400 + hour * 3600 + minute * 60 + second - offset_s;
    seconds.checked_mul(NS_PER_S)?.checked_add(fraction_ns(fraction)?)
}

fn split_zone(clock: &str) -> Option<(&str, i64)> {
    if let Some(clock) = clock.strip_suffix(['Z', 'z']) {
        return Some((clock, 0));
    }
    let Some(at) = clock.rfind(['+', '-']) else { return Some((clock, 0)) };
    let sign = if clock[at..].starts_with('-') { -1 } else { 1 };
    let digits: String = clock[at + 1..].chars().filter(|c| *c != ':').collect();
    let number: i64 = digits.parse().ok().filter(|n| (0..=9999).contains(n))?;
    let (hours, minutes) = if digits.len() <= 2 { (number, 0) } else { (number / 100, number % 100) };
    Some((&clock[..at], sign * (hours * 3600 + minutes * 60)))
}

fn fraction_ns(digits: &str) -> Option<i64> {
    if digits.is_empty() {
        return Some(0);
    }
    if !digits.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let kept = &digits[..digits.len().min(9)];
    let value: i64 = kept.parse().ok()?;
    let missing = 9 - u32::try_from(kept.len()).ok()?;
    Some(value * 10_i64.pow(missing))
}

/// Days since 1970-01-01 (Howard Hinnant, "chrono-compatible low-level date algorithms").
fn days_from_civil(year: i64, month: i64, day: i64) -> i64 {
    let year = if month <= 2 { year - 1 } else { year };
    let era = year.div_euclid(400);
    let year_of_era = year - era * 400;
    let day_of_year = (153 * (if month > 2 { month - 3 } else { month + 9 }) + 2) / 5 + day - 1;
    let day_of_era = year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year;
    era * 146_097 + day_of_era - 719_468
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_iso(text: &str, expected: Option<i64>) {
        assert_eq!(parse_iso8601(text), expected, "{text}");
    }

    #[test]
    fn iso_8601() {
        check_iso("1970-01-01T00:00:00Z", Some(0));
        check_iso("2025-06-15T15:06:40Z", Some(1_750_000_000_000_000_000));
        check_iso("2025-06-15T17:06:40.5+02:00", Some(1_750_000_000_500_000_000));
        check_iso("2025-06-15 15:06:40.123456789", Some(1_750_000_000_123_456_789));
        check_iso("2025-06-15T10:06:40-0500", Some(1_750_000_000_000_000_000));
        check_iso("2025-13-15T10:06:40Z", None);
        check_iso("yesterday", None);
        check_iso("", None);
        check_iso("T", None);
        check_iso("2025-06-15T10:06:40+\u{e9}", None);
    }

    #[test]
    fn numbers_scale_by_unit() {
        let stamp = |value, unit| {
            let mut stamp = Stamp::default();
            stamp.number(0, value);
            stamp.finish(StampForm::Parts(unit))
        };
        assert_eq!(stamp(Number::F64(1.5), StampUnit::Seconds), Some(1_500_000_000));
        assert_eq!(stamp(Number::F64(1.5), StampUnit::Auto), None);
        assert_eq!(stamp(Number::U64(1_750_000_000_000), StampUnit::Auto), Some(1_750_000_000_000_000_000));
        assert_eq!(
            stamp(Number::I64(1_750_000_000_000_000_001), StampUnit::Auto),
            Some(1_750_000_000_000_000_001)
        );
        assert_eq!(stamp(Number::I64(0), StampUnit::Seconds), None);
        assert_eq!(stamp(Number::F64(f64::NAN), StampUnit::Seconds), None);
        assert_eq!(stamp(Number::I64(i64::MAX), StampUnit::Seconds), None);
    }

    #[test]
    fn stamps_of_decoded_messages() {
        let check = |text: &str, expected: Option<i64>| {
            assert_eq!(stamp_of_json(&serde_json::from_str(text).unwrap()), expected, "{text}");
        };
        let ns = 1_750_000_000_250_000_000;
        check("1750000000.25", Some(ns));
        check("1750000000250", Some(ns));
        check("1750000000250000000", Some(ns));
        check("12.5", Some(12_500_000_000));
        check("\"2025-06-15T15:06:40.25Z\"", Some(ns));
        check(r#"{"sec": 1750000000, "nanosec": 250000000}"#, Some(ns));
        check(r#"{"seconds": 3}"#, Some(3_000_000_000));
        for nothing in ["null", "true", "{}", "[1]", "1e300", r#"{"sec": 9223372036854775807, "nanosec": 1}"#]
        {
            check(nothing, None);
        }
    }

    #[test]
    fn stamps_outside_the_wall_clock_are_classified() {
        assert_eq!(classify_stamp(1_750_000_000_000_000_000), StampClass::WallClock);
        assert_eq!(classify_stamp(12_000_000_000), StampClass::Other);
        assert_eq!(classify_stamp(-1), StampClass::Other);
    }
}
