//! Values of the continuous columns: which raw ones they are made of, how, and what they are.

use std::fmt::Write as _;

use gawm_dataset::GawmMeta;
use gawm_schema::{EncodedDim, FeatureData};

use super::dataset::{RowOrigin, encoded};
use super::{ExplainError, Question, Target, describe as words};

/// A value of a continuous column that is asked about.
pub(super) struct Asked<'a> {
    meta: &'a GawmMeta,
    column: &'a str,
    position: usize,
    dim: &'a EncodedDim,
}

/// Returns the value of a continuous column that a name means, if it means no raw one.
pub(super) fn asked<'a>(meta: &'a GawmMeta, name: &str) -> Option<Asked<'a>> {
    let is_raw = meta.schema.features.iter().any(|feature| {
        let FeatureData::Vector { parts, .. } = &feature.data else { return feature.name == name };
        parts.iter().flat_map(|part| &part.dims).any(|dim| dim.name == name)
    });
    let mut found = meta.encodings.iter().flat_map(|(column, dims)| {
        dims.iter().enumerate().map(move |(position, dim)| Asked { meta, column, position, dim })
    });
    found.find(|asked| {
        let Asked { column, position, dim, .. } = asked;
        name == format!("{column}[{position}]")
            || name == format!("{column}.{}", dim.name)
            || (!is_raw && name == dim.name)
    })
}

/// Returns the names of all values of continuous columns.
pub(super) fn names(meta: &GawmMeta) -> impl Iterator<Item = String> {
    meta.encodings
        .iter()
        .flat_map(|(column, dims)| dims.iter().map(move |dim| format!("{column}.{}", dim.name)))
}

impl<'a> Asked<'a> {
    fn targets(&self) -> impl Iterator<Item = Target<'a>> {
        let feature = self.meta.schema.features.iter().find(|feature| feature.name == self.dim.feature);
        let raw_dims = &self.dim.raw_dims;
        feature.into_iter().flat_map(move |feature| {
            let dims: Vec<&str> = match &feature.data {
                FeatureData::Vector { parts, .. } => {
                    parts.iter().flat_map(|part| &part.dims).map(|dim| dim.name.as_str()).collect()
                }
                FeatureData::Image(_) => Vec::new(),
            };
            let indices: Vec<usize> =
                raw_dims.iter().filter_map(|raw| dims.iter().position(|name| name == raw)).collect();
            indices.into_iter().map(move |index| Target { feature, index: Some(index) })
        })
    }

    /// Returns the first raw value that it is made of.
    pub(super) fn target(&self) -> Result<Target<'a>, ExplainError> {
        self.targets()
            .next()
            .ok_or_else(|| ExplainError::Dim { dim: self.dim.name.clone(), known: self.dim.raw_dims.clone() })
    }

    /// Returns the other raw values that it is made of.
    pub(super) fn others(&self) -> impl Iterator<Item = Target<'a>> {
        self.targets().skip(1)
    }

    /// Writes what it is.
    pub(super) fn head(
        &self,
        text: &mut String,
        question: &Question<'_>,
        origin: &RowOrigin,
    ) -> std::fmt::Result {
        let Asked { column, position, dim, .. } = self;
        let row = encoded(question.dir, origin.file_number, column, (question.episode, question.frame));
        let shown =
            |values: &[f64]| values.get(*position).map_or("absent".to_owned(), |value| format!("{value:?}"));
        writeln!(
            text,
            "{column}[{position}] {:?} in episode {}, frame {}: {}, in gawm/encoded {}; made of",
            dim.name,
            question.episode,
            question.frame,
            shown(&row.plain),
            shown(&row.standardised)
        )
    }
}

/// Writes the kind of a raw value, and the values of continuous columns that are made of it.
pub(super) fn describe(
    text: &mut String,
    question: &Question<'_>,
    meta: &GawmMeta,
    target: &Target<'_>,
    origin: &RowOrigin,
) -> std::fmt::Result {
    let FeatureData::Vector { parts, .. } = &target.feature.data else { return Ok(()) };
    let Some(dim) = parts.iter().flat_map(|part| &part.dims).nth(target.index.unwrap_or_default()) else {
        return Ok(());
    };
    let part = parts.iter().find(|part| part.dims.iter().any(|other| other.name == dim.name));
    writeln!(text, "  kind: {}", part.map(|part| words::kind(part.kind)).unwrap_or_default())?;
    for (column, dims) in &meta.encodings {
        let mut row = None;
        for (position, made) in dims.iter().enumerate() {
            if made.feature != target.feature.name || !made.raw_dims.contains(&dim.name) {
                continue;
            }
            let place = (question.episode, question.frame);
            let row = row.get_or_insert_with(|| encoded(question.dir, origin.file_number, column, place));
            let plain = row.plain.get(position).copied().unwrap_or(f64::NAN);
            let standard = meta.standardisation.iter().find(|fit| fit.column == *column);
            let standardised = match standard.and_then(|fit| fit.dims.get(position)) {
                Some(fit) if fit.is_standardised => {
                    let result = row.standardised.get(position).map(|value| format!(" = {value:?}"));
                    let constant =
                        if fit.is_constant { " (constant in the training data: scale 1)" } else { "" };
                    format!(
                        "standardised ({plain:?} - {:?}) / {:?}{}{constant}",
                        fit.mean,
                        fit.scale,
                        result.unwrap_or_default()
                    )
                }
                _ => "not standardised".to_owned(),
            };
            writeln!(
                text,
                "  encoding: {column}[{position}] {:?} ({} of {}) = {plain:?}, {standardised}",
                made.name,
                words::encoding(made.encoding),
                made.raw_dims.join(", ")
            )?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use crate::explain::{ExplainError, Question, explain};
    use crate::run::made_logs::{LogWriter, run_over};

    #[test]
    fn an_encoded_value_is_explained_by_the_raw_ones_it_is_made_of() {
        let dir = tempfile::tempdir().unwrap();
        let mut log = LogWriter::new(dir.path());
        for i in 0..10_u64 {
            let (sin, cos) = (i as f64 / 10.0).sin_cos();
            let text = format!("{{\"q\": [0, 0, {sin}, {cos}], \"u\": {}}}", i * i);
            log.write("/body", i * 100, text.as_bytes());
        }
        let text = "[ticks]\nrate_hz = 10\n[[stream]]\nname = \"q\"\ntopic = \"/body\"\nfields = [\"q[0:4]\"]\n\
            feature = \"observation.state\"\ntolerance_ms = 150\nkind = \"quaternion\"\norder = \"xyzw\"\n\
            [[stream]]\nname = \"u\"\ntopic = \"/body\"\nfields = [\"u\"]\nfeature = \"action\"\ntolerance_ms = 150\n\
            action = { timing = \"in-force\" }\n";
        let (path, out) = (log.finish(), dir.path().join("out"));
        run_over(text, &path, &out, 1).unwrap();
        let logs = [path];
        let ask = |dim: &str, logs: &[std::path::PathBuf]| {
            explain(&Question { dir: &out, episode: 0, frame: 3, dim, logs })
        };
        let expected = f64::from((2.0 * 0.3_f64).cos() as f32);
        for dim in ["q.r00", "gawm.state[0]", "gawm.state.q.r00"] {
            let said = ask(dim, &logs).unwrap();
            let head = said.lines().next().unwrap();
            let value: f64 = head.split(": ").nth(1).unwrap().split(',').next().unwrap().parse().unwrap();
            assert!((value - expected).abs() < 1e-6, "{said}");
            assert_eq!(said.matches("> ").count() - said.matches("(>").count(), 4, "{said}");
        }
        let said = ask("gawm.action[0]", &logs).unwrap();
        assert!(said.contains("= 9.0, standardised (9.0 - "), "{said}");
        assert!(said.contains(": 9.0, in gawm/encoded "), "{said}");
        assert!(
            matches!(ask("q.r99", &logs), Err(ExplainError::Dim { known, .. }) if known.iter().any(|name| name == "gawm.state.q.r00"))
        );
        let said = ask("u", &logs).unwrap();
        assert!(!said.contains("not valid") && !said.contains("share"), "{said}");
        let other = [out.join("meta/info.json")];
        assert!(ask("u", &other).unwrap().contains("none of the files given with --log is the source"));
    }
}
