//! Units of recorded values and their conversion to SI.

use crate::Unit;

/// How values in a recorded unit become SI values: `si = recorded * factor + offset`.
#[derive(Debug, Clone, PartialEq)]
pub struct UnitConversion {
    /// The unit after conversion.
    pub si: Unit,
    /// What the recorded value is multiplied by.
    pub factor: f64,
    /// What is added after that; only temperatures have one.
    pub offset: f64,
    /// Whether the unit was recognised; if not, it is kept as it is with factor 1.
    pub is_known: bool,
}

impl UnitConversion {
    /// Converts one recorded value.
    pub fn apply(&self, value: f64) -> f64 {
        if self.is_identity() { value } else { value * self.factor + self.offset }
    }

    /// Returns the recorded value of an SI value.
    pub fn invert(&self, value: f64) -> f64 {
        if self.is_identity() { value } else { (value - self.offset) / self.factor }
    }

    /// Returns whether conversion changes nothing.
    pub fn is_identity(&self) -> bool {
        self.factor == 1.0 && self.offset == 0.0
    }
}

impl Unit {
    /// Returns the SI unit of a recorded unit and how to convert to it.
    ///
    /// Spellings are those of logs and data sheets (`deg`, `°`, `mm`, `rpm`, `deg/s`, `percent`, ...); letter case
    /// matters only where SI needs it. The empty text, `1` and `-` are the pure number. A unit that is not in the
    /// table is kept as it is, with factor 1 and [`UnitConversion::is_known`] false, so that the caller can warn.
    pub fn conversion(text: &str) -> UnitConversion {
        let text = text.trim();
        let lower = text.to_lowercase();
        let found = TABLE
            .iter()
            .find(|entry| entry.0.contains(&text))
            .or_else(|| TABLE.iter().find(|entry| entry.0.iter().any(|name| name.to_lowercase() == lower)));
        match found {
            Some(&(_, si, factor, offset)) => {
                UnitConversion { si: Unit(si.to_owned()), factor, offset, is_known: true }
            }
            None => UnitConversion { si: Unit(text.to_owned()), factor: 1.0, offset: 0.0, is_known: false },
        }
    }
}

const DEG: f64 = std::f64::consts::PI / 180.0;
const TURN: f64 = 2.0 * std::f64::consts::PI;

/// Spellings, SI unit, factor, offset. The first exact spelling wins, then the first that differs in case only.
type Entry = (&'static [&'static str], &'static str, f64, f64);

#[rustfmt::skip]
const TABLE: &[Entry] = &[
    (&["", "1", "-", "none", "unitless", "ratio", "fraction", "bool", "count", "counts"], "1", 1.0, 0.0),
    (&["%", "percent"], "1", 0.01, 0.0),
    // angles
    (&["rad", "radian", "radians"], "rad", 1.0, 0.0),
    (&["deg", "degree", "degrees", "°"], "rad", DEG, 0.0),
    (&["mrad"], "rad", 1e-3, 0.0),
    (&["turn", "turns", "rev", "revolution", "revolutions"], "rad", TURN, 0.0),
    // lengths
    (&["m", "metre", "meter", "metres", "meters"], "m", 1.0, 0.0),
    (&["km"], "m", 1e3, 0.0),
    (&["dm"], "m", 0.1, 0.0),
    (&["cm"], "m", 0.01, 0.0),
    (&["mm"], "m", 1e-3, 0.0),
    (&["um", "µm", "μm", "micron", "microns"], "m", 1e-6, 0.0),
    (&["in", "inch", "inches"], "m", 0.0254, 0.0),
    (&["ft", "foot", "feet"], "m", 0.3048, 0.0),
    // times
    (&["s", "sec", "second", "seconds"], "s", 1.0, 0.0),
    (&["ms", "msec", "millisecond", "milliseconds"], "s", 1e-3, 0.0),
    (&["us", "µs", "μs", "usec", "microsecond", "microseconds"], "s", 1e-6, 0.0),
    (&["ns", "nsec", "nanosecond", "nanoseconds"], "s", 1e-9, 0.0),
    (&["min", "minute", "minutes"], "s", 60.0, 0.0),
    (&["h", "hour", "hours"], "s", 3600.0, 0.0),
    (&["Hz", "1/s"], "Hz", 1.0, 0.0),
    (&["kHz"], "Hz", 1e3, 0.0),
    // velocities
    (&["m/s", "mps", "m s-1"], "m/s", 1.0, 0.0),
    (&["cm/s"], "m/s", 0.01, 0.0),
    (&["mm/s"], "m/s", 1e-3, 0.0),
    (&["km/h", "kph", "kmh"], "m/s", 1.0 / 3.6, 0.0),
    (&["mph"], "m/s", 0.44704, 0.0),
    (&["kn", "knot", "knots"], "m/s", 1852.0 / 3600.0, 0.0),
    (&["rad/s", "radians/s"], "rad/s", 1.0, 0.0),
    (&["deg/s", "dps", "°/s", "degrees/s"], "rad/s", DEG, 0.0),
    (&["rpm", "rev/min", "1/min"], "rad/s", TURN / 60.0, 0.0),
    (&["rps", "rev/s"], "rad/s", TURN, 0.0),
    // accelerations
    (&["m/s^2", "m/s2", "m/s²"], "m/s^2", 1.0, 0.0),
    (&["mm/s^2", "mm/s2", "mm/s²"], "m/s^2", 1e-3, 0.0),
    (&["g0", "gee"], "m/s^2", 9.806_65, 0.0),
    (&["rad/s^2", "rad/s2", "rad/s²"], "rad/s^2", 1.0, 0.0),
    (&["deg/s^2", "deg/s2", "deg/s²", "°/s²"], "rad/s^2", DEG, 0.0),
    // masses, forces, torques
    (&["kg"], "kg", 1.0, 0.0),
    (&["g", "gram", "grams"], "kg", 1e-3, 0.0),
    (&["lb", "lbs"], "kg", 0.453_592_37, 0.0),
    (&["N", "newton", "newtons"], "N", 1.0, 0.0),
    (&["mN"], "N", 1e-3, 0.0),
    (&["kN"], "N", 1e3, 0.0),
    (&["lbf"], "N", 4.448_221_615_260_5, 0.0),
    (&["kgf"], "N", 9.806_65, 0.0),
    (&["N*m", "Nm", "N.m", "N·m", "N m"], "N*m", 1.0, 0.0),
    (&["mNm", "mN*m", "mN·m"], "N*m", 1e-3, 0.0),
    (&["Ncm", "N*cm"], "N*m", 0.01, 0.0),
    // pressure, temperature, electricity
    (&["Pa"], "Pa", 1.0, 0.0),
    (&["hPa", "mbar"], "Pa", 100.0, 0.0),
    (&["kPa"], "Pa", 1e3, 0.0),
    (&["MPa"], "Pa", 1e6, 0.0),
    (&["bar"], "Pa", 1e5, 0.0),
    (&["psi"], "Pa", 6_894.757_293_168_36, 0.0),
    (&["K", "kelvin"], "K", 1.0, 0.0),
    (&["degC", "°C", "celsius"], "K", 1.0, 273.15),
    (&["degF", "°F", "fahrenheit"], "K", 5.0 / 9.0, 459.67 * 5.0 / 9.0),
    (&["V", "volt", "volts"], "V", 1.0, 0.0),
    (&["mV"], "V", 1e-3, 0.0),
    (&["A", "amp", "amps", "ampere", "amperes"], "A", 1.0, 0.0),
    (&["mA"], "A", 1e-3, 0.0),
    (&["W", "watt", "watts"], "W", 1.0, 0.0),
    (&["kW"], "W", 1e3, 0.0),
    (&["J", "joule", "joules"], "J", 1.0, 0.0),
    (&["Wh"], "J", 3600.0, 0.0),
    (&["T", "tesla"], "T", 1.0, 0.0),
    (&["uT", "µT", "μT"], "T", 1e-6, 0.0),
];

#[cfg(test)]
mod tests {
    use super::*;

    fn check_conversion(text: &str, recorded: f64, si: &str, expected: f64) {
        let conversion = Unit::conversion(text);
        assert_eq!(conversion.si.0, si, "{text}");
        let got = conversion.apply(recorded);
        assert!((got - expected).abs() <= 1e-12 * (1.0 + expected.abs()), "{text}: {got} != {expected}");
        assert!((conversion.invert(got) - recorded).abs() <= 1e-12 * (1.0 + recorded.abs()), "{text} back");
    }

    #[test]
    fn converts_to_si() {
        check_conversion("deg", 180.0, "rad", std::f64::consts::PI);
        check_conversion(" ° ", 90.0, "rad", std::f64::consts::FRAC_PI_2);
        check_conversion("mm", 1500.0, "m", 1.5);
        check_conversion("rpm", 60.0, "rad/s", TURN);
        check_conversion("deg/s", 180.0, "rad/s", std::f64::consts::PI);
        check_conversion("ms", 20.0, "s", 0.02);
        check_conversion("km/h", 36.0, "m/s", 10.0);
        check_conversion("percent", 50.0, "1", 0.5);
        check_conversion("°C", 20.0, "K", 293.15);
        check_conversion("degF", 32.0, "K", 273.15);
        check_conversion("", 3.0, "1", 3.0);
        check_conversion("Degrees", 180.0, "rad", std::f64::consts::PI);
    }

    #[test]
    fn letter_case_decides_where_si_needs_it() {
        assert_eq!(Unit::conversion("mN").factor, 1e-3);
        assert_eq!(Unit::conversion("MPa").factor, 1e6);
        assert_eq!(Unit::conversion("g").si.0, "kg");
        assert_eq!(Unit::conversion("K").offset, 0.0);
    }

    #[test]
    fn keeps_an_unknown_unit() {
        let conversion = Unit::conversion("furlong");
        assert!(!conversion.is_known && conversion.is_identity());
        assert_eq!(conversion.si.0, "furlong");
    }

    #[test]
    fn every_spelling_is_listed_once() {
        let mut names: Vec<&str> = TABLE.iter().flat_map(|entry| entry.0.iter().copied()).collect();
        let count = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), count);
    }
}
