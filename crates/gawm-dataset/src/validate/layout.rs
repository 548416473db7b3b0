//! What the columns of numbers mean: roles, kinds, units and groups of dims, from declarations and names.

use std::f64::consts::TAU;

use gawm_schema::{FeatureData, Kind, Role, Schema, Wrap};

use crate::read::{DType, Dataset, FeatureDecl};

/// What a feature is for, as far as rules need to know it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    State,
    Action,
    /// Columns that gawm derives from state and action.
    Encoded,
    Other,
}

/// What a single dim is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum DimKind {
    /// Nothing is declared.
    Unknown,
    /// Declared Euclidean.
    Linear,
    /// A declared angle that counts turns or has limits.
    Angle,
    /// A declared angle that wraps after `period`.
    Wrapped {
        period: f64,
    },
    Gripper,
    Bool,
    /// A component of a rotation.
    Rotation,
}

/// Dims that belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum GroupKind {
    Quaternion,
    SinCos,
    SixD,
    Matrix,
}

impl GroupKind {
    pub(super) fn width(self) -> usize {
        match self {
            GroupKind::SinCos => 2,
            GroupKind::Quaternion => 4,
            GroupKind::SixD => 6,
            GroupKind::Matrix => 9,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Group {
    pub(super) kind: GroupKind,
    pub(super) start: usize,
}

/// One column of numbers.
#[derive(Debug, Clone)]
pub(super) struct FeatureLayout {
    pub(super) name: String,
    pub(super) purpose: Purpose,
    pub(super) names: Vec<String>,
    pub(super) kinds: Vec<DimKind>,
    pub(super) units: Vec<String>,
    pub(super) limits: Vec<Option<[f64; 2]>>,
    pub(super) groups: Vec<Group>,
    pub(super) has_names: bool,
}

impl FeatureLayout {
    pub(super) fn width(&self) -> usize {
        self.kinds.len()
    }

    /// Returns whether dim `dim` is labelled in radians.
    pub(super) fn is_radian(&self, dim: usize) -> bool {
        let unit = self.units[dim].trim().to_ascii_lowercase();
        let name = self.names[dim].to_ascii_lowercase();
        matches!(self.kinds[dim], DimKind::Angle | DimKind::Wrapped { .. }) && !unit.starts_with("deg")
            || matches!(unit.as_str(), "rad" | "radian" | "radians")
            || name.ends_with("_rad")
            || name.ends_with(".rad")
    }
}

/// Columns that are bookkeeping, not robot data.
pub(super) const BOOKKEEPING: [&str; 5] =
    ["timestamp", "frame_index", "episode_index", "index", "task_index"];

/// Returns the layouts of all columns of numbers that carry robot data.
pub(super) fn layouts(dataset: &Dataset) -> Vec<FeatureLayout> {
    let is_data = |f: &&FeatureDecl| {
        matches!(f.dtype, DType::Float)
            && !BOOKKEEPING.contains(&f.name.as_str())
            && !f.name.starts_with("next.")
    };
    let features = dataset.info.features.iter().filter(is_data);
    features
        .filter(|f| !f.name.starts_with("gawm.") || matches!(f.name.as_str(), "gawm.state" | "gawm.action"))
        .filter(|f| dataset.files.iter().any(|file| file.schema.field_with_name(&f.name).is_ok()))
        .map(|f| layout_of(f, dataset.schema.as_ref()))
        .collect()
}

fn layout_of(feature: &FeatureDecl, schema: Option<&Schema>) -> FeatureLayout {
    let width = feature.width();
    let has_names = feature.names.len() == width && !feature.names.iter().all(|n| is_numbered(n));
    let purpose = match feature.name.as_str() {
        "gawm.state" | "gawm.action" => Purpose::Encoded,
        "action" => Purpose::Action,
        "observation.state" => Purpose::State,
        name if name.starts_with("action.") => Purpose::Action,
        name if name.starts_with("observation.state.") => Purpose::State,
        _ => Purpose::Other,
    };
    let unit = |i: usize| {
        feature.units.get(if feature.units.len() == 1 { 0 } else { i }).cloned().unwrap_or_default()
    };
    let mut layout = FeatureLayout {
        name: feature.name.clone(),
        purpose,
        names: (0..width).map(|i| feature.dim_name(i)).collect(),
        kinds: vec![DimKind::Unknown; width],
        units: (0..width).map(unit).collect(),
        limits: vec![None; width],
        groups: Vec::new(),
        has_names,
    };
    let typed = schema.and_then(|s| s.features.iter().find(|f| f.name == feature.name && f.width() == width));
    if let Some(typed) = typed {
        apply_schema(&mut layout, typed);
    } else if has_names {
        apply_names(&mut layout);
    }
    layout
}

fn apply_schema(layout: &mut FeatureLayout, typed: &gawm_schema::Feature) {
    layout.purpose = match typed.role {
        Role::State => Purpose::State,
        Role::Action => Purpose::Action,
        _ => Purpose::Other,
    };
    let FeatureData::Vector { parts, .. } = &typed.data else { return };
    let mut at = 0;
    for part in parts {
        let group = match part.kind {
            Kind::Quaternion { .. } => Some(GroupKind::Quaternion),
            Kind::Matrix => Some(GroupKind::Matrix),
            _ => None,
        };
        for (i, dim) in part.dims.iter().enumerate() {
            layout.names[at] = dim.name.clone();
            layout.units[at] = dim.unit.0.clone();
            layout.limits[at] = dim.limits;
            layout.kinds[at] = match part.kind {
                Kind::Linear => DimKind::Linear,
                Kind::Angle { wrap: Wrap::None } => DimKind::Angle,
                Kind::Angle { .. } => DimKind::Wrapped { period: TAU },
                Kind::Gripper => DimKind::Gripper,
                Kind::Bool => DimKind::Bool,
                _ => DimKind::Rotation,
            };
            if let Some(kind) = group
                && i % kind.width() == 0
            {
                layout.groups.push(Group { kind, start: at });
            }
            at += 1;
        }
    }
    layout.has_names = !layout.names.iter().all(|n| is_numbered(n));
}

/// Returns whether a name only counts: `3`, `data_3`, `dim3`.
fn is_numbered(name: &str) -> bool {
    let word = name.trim_end_matches(|c: char| c.is_ascii_digit());
    let word = word.trim_end_matches(['_', '.', '-', '[']).to_ascii_lowercase();
    name.ends_with(|c: char| c.is_ascii_digit())
        && matches!(word.as_str(), "" | "data" | "dim" | "value" | "element" | "x")
}

/// Takes what the names of dims say where nothing is declared.
fn apply_names(layout: &mut FeatureLayout) {
    let lower: Vec<String> = layout.names.iter().map(|n| n.to_ascii_lowercase()).collect();
    let last = |i: usize| lower[i].rsplit(['.', '_', '/', ' ', '-']).next().unwrap_or("").to_owned();
    let stem = |i: usize| lower[i].strip_suffix(&last(i)).unwrap_or("").to_owned();
    let width = lower.len();
    for i in 0..width {
        let ends = |k: usize, suffixes: &[&str]| (0..k).all(|j| i + j < width && last(i + j) == suffixes[j]);
        let is_rotation = ["quat", "rot", "orient"].iter().any(|word| lower[i].contains(word));
        if ends(4, &["qx", "qy", "qz", "qw"])
            || ends(4, &["qw", "qx", "qy", "qz"])
            || is_rotation && (ends(4, &["x", "y", "z", "w"]) || ends(4, &["w", "x", "y", "z"]))
        {
            layout.groups.push(Group { kind: GroupKind::Quaternion, start: i });
        }
        // The cosine of one angle before the sine of the next is no point on the circle.
        let is_free = layout.groups.iter().all(|g| g.start + g.kind.width() <= i);
        let is_one_angle = i + 1 < width && stem(i) == stem(i + 1);
        if is_free && is_one_angle && (ends(2, &["sin", "cos"]) || ends(2, &["cos", "sin"])) {
            layout.groups.push(Group { kind: GroupKind::SinCos, start: i });
        }
        let is_six = |j: usize| lower[j].contains("6d") || lower[j].contains("rot6");
        let is_matrix = ends(6, &["r00", "r10", "r20", "r01", "r11", "r21"]);
        if i + 6 <= width
            && (is_matrix || (i..i + 6).all(is_six))
            && layout.groups.iter().all(|g| g.start + g.kind.width() <= i)
        {
            layout.groups.push(Group { kind: GroupKind::SixD, start: i });
        }
        if lower[i].contains("gripper") {
            layout.kinds[i] = DimKind::Gripper;
        }
    }
    for group in &layout.groups {
        layout.kinds[group.start..group.start + group.kind.width()].fill(DimKind::Rotation);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_groups(names: &[&str], expected: &[(GroupKind, usize)]) {
        let n = names.len();
        let mut layout = FeatureLayout {
            name: "x".into(),
            purpose: Purpose::Other,
            names: names.iter().map(|n| (*n).to_owned()).collect(),
            kinds: vec![DimKind::Unknown; n],
            units: vec![String::new(); n],
            limits: vec![None; n],
            groups: Vec::new(),
            has_names: true,
        };
        apply_names(&mut layout);
        let found: Vec<(GroupKind, usize)> = layout.groups.iter().map(|g| (g.kind, g.start)).collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn names_tell_groups() {
        use GroupKind::{Quaternion, SinCos, SixD};
        check_groups(&["a.sin", "a.cos", "b.sin", "b.cos", "grip"], &[(SinCos, 0), (SinCos, 2)]);
        check_groups(&["a.cos", "b.sin"], &[]);
        check_groups(&["x", "tool.qx", "tool.qy", "tool.qz", "tool.qw"], &[(Quaternion, 1)]);
        check_groups(&["t_quat.w", "t_quat.x", "t_quat.y", "t_quat.z"], &[(Quaternion, 0)]);
        check_groups(&["r_6d_0", "r_6d_1", "r_6d_2", "r_6d_3", "r_6d_4", "r_6d_5"], &[(SixD, 0)]);
    }
}
