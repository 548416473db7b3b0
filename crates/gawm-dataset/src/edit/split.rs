//! `split`: episodes into several datasets, by episode or by session.

use std::collections::BTreeMap;
use std::ops::Range;

use gawm_schema::ContentHash;

use super::{EditError, Input, Piece, Plan};
use crate::read::Dataset;

/// What is never cut in two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SplitBy {
    /// An episode.
    Episode,
    /// All episodes of a session.
    Session,
}

/// One output of a split.
#[derive(Debug, Clone, PartialEq)]
pub enum SplitPart {
    /// About this share of the episodes.
    Share {
        /// Name of the output folder.
        name: String,
        /// The share, in 0..=1.
        share: f64,
    },
    /// These episodes, by index.
    Episodes {
        /// Name of the output folder.
        name: String,
        /// Half-open ranges of episode indices.
        ranges: Vec<Range<i64>>,
    },
}

impl SplitPart {
    fn name(&self) -> &str {
        match self {
            SplitPart::Share { name, .. } | SplitPart::Episodes { name, .. } => name,
        }
    }
}

/// Parses `train=0.8` or `val=0:10,12,20:30`.
///
/// # Errors
/// The text is neither, or the name is no plain folder name.
pub fn parse_part(text: &str) -> Result<SplitPart, EditError> {
    let wrong = |expected: &str| EditError::Argument {
        what: format!("--into {text:?}"),
        expected: expected.to_owned(),
        got: "something else".to_owned(),
    };
    let (name, value) = text.split_once('=').ok_or_else(|| wrong("NAME=SHARE or NAME=RANGES"))?;
    if !is_folder_name(name) {
        return Err(wrong("a name of letters, digits, '.', '_' and '-'"));
    }
    if value.contains('.') || value.ends_with('%') {
        let share = match value.strip_suffix('%') {
            Some(percent) => percent.parse::<f64>().map(|p| p / 100.0),
            None => value.parse(),
        };
        let share = share.ok().filter(|share| *share > 0.0 && *share <= 1.0);
        let share = share.ok_or_else(|| wrong("a share above 0 and at most 1, such as 0.8"))?;
        return Ok(SplitPart::Share { name: name.to_owned(), share });
    }
    let mut ranges = Vec::new();
    for part in value.split(',') {
        let (from, to) = match part.split_once(':') {
            Some((from, to)) => (from.trim().parse().ok(), to.trim().parse().ok()),
            None => {
                let one: Option<i64> = part.trim().parse().ok();
                (one, one.and_then(|one| one.checked_add(1)))
            }
        };
        match (from, to) {
            (Some(from), Some(to)) if 0 <= from && from < to => ranges.push(from..to),
            _ => return Err(wrong("a share such as 0.8, or episodes such as 0:10,12 (the end is not in)")),
        }
    }
    Ok(SplitPart::Episodes { name: name.to_owned(), ranges })
}

fn is_folder_name(name: &str) -> bool {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    !name.is_empty() && name.len() <= 100 && !name.starts_with(['.', '-']) && name.chars().all(is_plain)
}

/// Plans one output per part; returns the name of each with its plan.
///
/// Shares are met as closely as whole groups allow. Which group goes where depends on `seed` and the names of the groups.
/// Episodes that no part names are in no output.
///
/// # Errors
/// - shares add up to more than 1, names occur twice, or shares and ranges are mixed;
/// - there are fewer groups than parts, ranges overlap or name episodes that do not exist;
/// - no episode has a session.
pub fn split(
    input: &Input,
    by: SplitBy,
    parts: &[SplitPart],
    seed: u64,
) -> Result<Vec<(String, Plan)>, EditError> {
    check_parts(parts, by)?;
    let pieces = input.pieces(0);
    let groups = groups(input, by, &pieces)?;
    let chosen = if parts.iter().all(|part| matches!(part, SplitPart::Share { .. })) {
        by_share(parts, &groups, pieces.len(), seed)?
    } else {
        by_range(&input.dataset, parts, &pieces)?
    };
    let plan = |(part, mut numbers): (&SplitPart, Vec<usize>)| {
        numbers.sort_unstable();
        let mut plan = Plan { verb: "split".to_owned(), ..Plan::default() };
        plan.pieces = numbers.into_iter().map(|number| pieces[number].clone()).collect();
        let by = if by == SplitBy::Episode { "episode" } else { "session" };
        for (name, value) in [("by", by.to_owned()), ("into", shown(part)), ("seed", seed.to_string())] {
            plan.arguments.insert(name.to_owned(), value);
        }
        (part.name().to_owned(), plan)
    };
    Ok(parts.iter().zip(chosen).map(plan).collect())
}

fn shown(part: &SplitPart) -> String {
    match part {
        SplitPart::Share { name, share } => format!("{name}={share}"),
        SplitPart::Episodes { name, ranges } => {
            let ranges: Vec<String> = ranges.iter().map(|r| format!("{}:{}", r.start, r.end)).collect();
            format!("{name}={}", ranges.join(","))
        }
    }
}

fn refuse<T>(
    what: impl Into<String>,
    expected: impl Into<String>,
    got: impl Into<String>,
) -> Result<T, EditError> {
    Err(EditError::Argument { what: what.into(), expected: expected.into(), got: got.into() })
}

fn check_parts(parts: &[SplitPart], by: SplitBy) -> Result<(), EditError> {
    for (i, part) in parts.iter().enumerate() {
        if parts[..i].iter().any(|other| other.name() == part.name()) {
            return refuse("--into", "different names", format!("{:?} twice", part.name()));
        }
    }
    let shares = parts.iter().filter_map(|part| match part {
        SplitPart::Share { share, .. } => Some(*share),
        SplitPart::Episodes { .. } => None,
    });
    let (n_shares, total) = shares.fold((0, 0.0), |(n, sum), share| (n + 1, sum + share));
    if parts.is_empty() {
        return refuse("--into", "one part or more", "none");
    }
    if n_shares != 0 && n_shares != parts.len() {
        return refuse("--into", "shares or ranges of episodes", "both");
    }
    if n_shares == 0 && by == SplitBy::Session {
        return refuse("--by session", "shares such as train=0.8", "ranges of episodes");
    }
    if total > 1.0 + 1e-9 {
        return refuse("--into", "shares that add up to 1 at most", total.to_string());
    }
    Ok(())
}

/// Returns the groups that stay together: their names and the positions of their pieces.
fn groups(input: &Input, by: SplitBy, pieces: &[Piece]) -> Result<Vec<(String, Vec<usize>)>, EditError> {
    let mut groups: BTreeMap<String, Vec<usize>> = BTreeMap::new();
    let mut has_session = false;
    for (number, piece) in pieces.iter().enumerate() {
        let episode = input.dataset.runs[piece.run].episode_index;
        let entry = input.dataset.entry(episode);
        let session = entry.and_then(|entry| entry.extra_text("session")).filter(|text| !text.is_empty());
        has_session |= session.is_some();
        // An episode without a session is its own.
        let id = || {
            let id = entry.and_then(|entry| entry.extra_text("gawm/episode_id"));
            format!("episode {}", id.unwrap_or_else(|| episode.to_string()))
        };
        let name = match (by, session) {
            (SplitBy::Session, Some(session)) => format!("session {session}"),
            _ => id(),
        };
        groups.entry(name).or_default().push(number);
    }
    if by == SplitBy::Session && !has_session {
        return refuse(
            "--by session",
            "a column session in meta/episodes",
            "no episode that says its session; --by episode splits without",
        );
    }
    Ok(groups.into_iter().collect())
}

/// Orders in which groups of different sizes are dealt out.
const MAX_DEALS: u32 = 64;
/// Share of all episodes by which the parts may miss their shares without another try.
const NEAR_ENOUGH: f64 = 0.01;

/// Shuffles the groups by their hash and deals them out, so that every part gets at least one.
fn by_share(
    parts: &[SplitPart],
    groups: &[(String, Vec<usize>)],
    n_episodes: usize,
    seed: u64,
) -> Result<Vec<Vec<usize>>, EditError> {
    if groups.len() < parts.len() {
        let what = groups.first().map_or("groups", |(name, _)| name.split(' ').next().unwrap_or("groups"));
        return refuse(
            "--into",
            format!("at most as many parts as there are {what}s"),
            format!("{} parts of {} {what}s", parts.len(), groups.len()),
        );
    }
    let goals: Vec<f64> = parts
        .iter()
        .map(|part| match part {
            SplitPart::Share { share, .. } => share * n_episodes as f64,
            SplitPart::Episodes { .. } => 0.0,
        })
        .collect();
    let missed = |chosen: &[Vec<usize>]| -> f64 {
        chosen.iter().zip(&goals).map(|(numbers, goal)| (numbers.len() as f64 - goal).abs()).sum()
    };
    // Groups of different sizes are dealt out several times: the first order may put a large one where a small one fits.
    let mut best = deal(groups, &goals, &seed.to_string());
    for attempt in 1..MAX_DEALS {
        if missed(&best) <= NEAR_ENOUGH * n_episodes as f64 {
            break;
        }
        let other = deal(groups, &goals, &format!("{seed}.{attempt}"));
        if missed(&other) < missed(&best) - 1e-9 {
            best = other;
        }
    }
    Ok(best)
}

/// Deals groups out in the order of their hashes: another one to a part as long as that brings the border nearer to where
/// it should be.
fn deal(groups: &[(String, Vec<usize>)], goals: &[f64], seed: &str) -> Vec<Vec<usize>> {
    let hashed = groups.iter().enumerate();
    let mut order: Vec<(ContentHash, usize)> =
        hashed.map(|(i, (name, _))| (ContentHash::of(format!("{seed} {name}").as_bytes()), i)).collect();
    order.sort_by_key(|(hash, _)| hash.0);
    let mut chosen: Vec<Vec<usize>> = vec![Vec::new(); goals.len()];
    let (mut next, mut goal) = (0, 0.0);
    let mut n_taken = 0usize;
    for (i, share) in goals.iter().enumerate() {
        goal += share;
        let n_after = goals.len() - i - 1;
        while next < order.len() - n_after {
            let group = &groups[order[next].1].1;
            let is_first = chosen[i].is_empty();
            if !is_first && (n_taken as f64 + 0.5 * group.len() as f64) > goal + 1e-9 {
                break;
            }
            chosen[i].extend(group);
            n_taken += group.len();
            next += 1;
        }
    }
    chosen
}

fn by_range(dataset: &Dataset, parts: &[SplitPart], pieces: &[Piece]) -> Result<Vec<Vec<usize>>, EditError> {
    let mut owner: BTreeMap<i64, &str> = BTreeMap::new();
    let last = pieces.iter().map(|piece| dataset.runs[piece.run].episode_index).max().unwrap_or(-1);
    let mut chosen = Vec::new();
    for part in parts {
        let SplitPart::Episodes { name, ranges } = part else { continue };
        let mut numbers = Vec::new();
        for range in ranges {
            if range.end > last.saturating_add(1) {
                return refuse(
                    format!("--into {}", shown(part)),
                    format!("episodes 0 to {last}"),
                    format!("episode {}", range.end - 1),
                );
            }
            for (number, piece) in pieces.iter().enumerate() {
                let episode = dataset.runs[piece.run].episode_index;
                if !range.contains(&episode) {
                    continue;
                }
                if let Some(other) = owner.insert(episode, name) {
                    return refuse(
                        "--into",
                        "each episode in one part",
                        format!("episode {episode} in {other:?} and {name:?}"),
                    );
                }
                numbers.push(number);
            }
        }
        if numbers.is_empty() {
            return refuse(format!("--into {}", shown(part)), "at least one episode", "none");
        }
        chosen.push(numbers);
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_part(text: &str, expected: Option<&str>) {
        assert_eq!(parse_part(text).ok().map(|part| shown(&part)).as_deref(), expected, "{text}");
    }

    #[test]
    fn parts_are_parsed_or_refused() {
        check_part("train=0.8", Some("train=0.8"));
        check_part("train=80%", Some("train=0.8"));
        check_part("val=0:10,12", Some("val=0:10,12:13"));
        check_part("all=1.0", Some("all=1"));
        for bad in [
            "train", "=0.5", "../x=0.5", "a/b=0.5", ".x=0.5", "x=1.5", "x=0.0", "x=5:5", "x=-1:3", "x=a",
            "x=",
        ] {
            check_part(bad, None);
        }
    }

    fn check_shares(sizes: &[usize], shares: &[f64], expected: &[usize]) {
        let mut next = 0;
        let groups: Vec<(String, Vec<usize>)> = sizes
            .iter()
            .enumerate()
            .map(|(i, n)| {
                next += n;
                (format!("session {i}"), (next - n..next).collect())
            })
            .collect();
        let parts: Vec<SplitPart> = shares
            .iter()
            .enumerate()
            .map(|(i, share)| SplitPart::Share { name: i.to_string(), share: *share })
            .collect();
        let chosen = by_share(&parts, &groups, sizes.iter().sum(), 0).unwrap();
        assert_eq!(chosen.iter().map(Vec::len).collect::<Vec<_>>(), expected, "{sizes:?} {shares:?}");
    }

    #[test]
    fn shares_are_met_as_groups_allow() {
        check_shares(&[1; 10], &[0.8, 0.2], &[8, 2]);
        check_shares(&[1; 10], &[0.8, 0.1, 0.1], &[8, 1, 1]);
        check_shares(&[5, 5], &[0.9, 0.1], &[5, 5]);
        check_shares(&[1; 3], &[0.98, 0.01, 0.01], &[1, 1, 1]);
        check_shares(&[1; 10], &[0.5], &[5]);
        check_shares(&[1, 2], &[0.8, 0.2], &[2, 1]);
        check_shares(&[2, 1], &[0.8, 0.2], &[2, 1]);
        check_shares(&[30, 1, 2, 7], &[0.75, 0.25], &[30, 10]);
    }
}
