//! Inconsistencies of a folder in the terms of logs.

use gawm_dataset::read::{Defect, DefectKind};

use crate::log::{Damage, DamageKind};

/// Says a defect in the terms of logs.
pub(super) fn damage_of(defect: &Defect) -> Damage {
    let kind = match defect.kind {
        DefectKind::UnreadableFile | DefectKind::MissingFile => DamageKind::ReadFailed,
        DefectKind::TooLarge => DamageKind::SizeLimit,
        DefectKind::WrongCount => DamageKind::StatisticsMismatch,
        DefectKind::UndeclaredColumn => DamageKind::IndexIncomplete,
        DefectKind::UnsafePath | DefectKind::StrayFile => DamageKind::UnexpectedRecord,
        DefectKind::MissingColumn | DefectKind::WrongType | DefectKind::BadFeature => {
            DamageKind::UnknownSchema
        }
        _ => DamageKind::IndexMismatch,
    };
    let episode = defect.episode.map(|episode| format!("episode {episode}, ")).unwrap_or_default();
    let detail = format!("{episode}{}: expected {}, got {}", defect.place, defect.expected, defect.got);
    Damage { kind, offset: 0, detail }
}
