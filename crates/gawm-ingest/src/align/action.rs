//! Actions: commands of a window as one, and actions made from states.

use gawm_schema::rotation::rotvec_from_quaternion;
use gawm_schema::{Kind, Wrap};

use super::interpolate::{inverse, multiplied, push_rotation, quaternion, short_way, wrapped};
use super::{Derivation, PartKind, Reduction};

/// Appends one command made of several; `commands` holds `n` rows of the parts' width, in time order.
pub(crate) fn reduced(reduction: Reduction, parts: &[PartKind], commands: &[f64], n: usize, out: &mut Vec<f64>) {
    let width = commands.len() / n.max(1);
    let mut at = 0;
    for part in parts {
        let raw = part.kind.raw_width();
        for start in (at..at + part.width).step_by(raw) {
            let column = || (0..n).map(|row| &commands[row * width + start..row * width + start + raw]);
            match (reduction, part.kind) {
                (Reduction::Last, _) => out.extend(column().last().into_iter().flatten()),
                (Reduction::Mean, Kind::Angle { wrap }) if wrap != Wrap::None => {
                    let (sin, cos) = column().fold((0.0, 0.0), |(s, c), v| (s + v[0].sin(), c + v[0].cos()));
                    out.push(wrapped(sin.atan2(cos), wrap));
                }
                (Reduction::Mean, _) => out.push(column().map(|v| v[0]).sum::<f64>() / n as f64),
                (Reduction::Compose { in_body_frame }, kind) if raw > 1 => {
                    let total = column().filter_map(|v| quaternion(kind, v)).fold([0.0, 0.0, 0.0, 1.0], |sum, q| {
                        if in_body_frame { multiplied(sum, q) } else { multiplied(q, sum) }
                    });
                    push_rotation(kind, total, out);
                }
                (Reduction::Sum | Reduction::Compose { .. }, _) => out.push(column().map(|v| v[0]).sum()),
            }
        }
        at += part.width;
    }
}

/// Appends the action that leads from one state to the next.
pub(crate) fn derived(derivation: Derivation, parts: &[PartKind], now: &[f64], next: &[f64], out: &mut Vec<f64>) {
    if derivation == Derivation::Next {
        return out.extend(next);
    }
    let mut at = 0;
    for part in parts {
        let raw = part.kind.raw_width();
        for start in (at..at + part.width).step_by(raw) {
            let (a, b) = (&now[start..start + raw], &next[start..start + raw]);
            match part.kind {
                Kind::Angle { wrap } if wrap != Wrap::None => out.push(short_way(a[0], b[0])),
                kind if raw > 1 => out.extend(match (quaternion(kind, a), quaternion(kind, b)) {
                    (Some(qa), Some(qb)) => rotvec_from_quaternion(multiplied(qb, inverse(qa))),
                    _ => [f64::NAN; 3],
                }),
                _ => out.push(b[0] - a[0]),
            }
        }
        at += part.width;
    }
}
