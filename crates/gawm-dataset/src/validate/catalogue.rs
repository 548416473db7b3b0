//! The rules: stable codes, what they look for, how bad it is, and what to do.

use super::Severity;

/// One rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rule {
    /// Stable code; codes are never reused.
    pub code: &'static str,
    /// Severity unless a finding says otherwise.
    pub severity: Severity,
    /// What the rule finds.
    pub title: &'static str,
    /// What to do about it.
    pub hint: &'static str,
}

/// Returns the rule with this code.
pub fn rule(code: &str) -> Option<&'static Rule> {
    RULES.iter().find(|rule| rule.code == code)
}

const fn error(code: &'static str, title: &'static str, hint: &'static str) -> Rule {
    Rule { code, severity: Severity::Error, title, hint }
}

const fn warning(code: &'static str, title: &'static str, hint: &'static str) -> Rule {
    Rule { code, severity: Severity::Warning, title, hint }
}

const fn info(code: &'static str, title: &'static str, hint: &'static str) -> Rule {
    Rule { code, severity: Severity::Info, title, hint }
}

/// All rules in the order of their codes.
pub const RULES: &[Rule] = &[
    error(
        "STRUCT-001",
        "a key of meta/info.json is missing or ill-typed",
        "complete meta/info.json; lerobot takes its keys without checking",
    ),
    error(
        "STRUCT-002",
        "a metadata file is missing or does not parse",
        "restore the file or write the dataset again",
    ),
    error(
        "STRUCT-003",
        "a path or link leaves the folder",
        "do not trust the folder; give relative paths inside it",
    ),
    error(
        "STRUCT-004",
        "a file that metadata name is missing",
        "copy the dataset again, or remove the episodes that need it",
    ),
    error(
        "STRUCT-005",
        "a Parquet file cannot be read",
        "copy the file again; a file without a footer was not closed",
    ),
    warning(
        "STRUCT-006",
        "a file lies where readers glob but no metadata name it",
        "move it out of data/: lerobot reads every Parquet file there",
    ),
    error(
        "STRUCT-007",
        "a declared feature has no column",
        "write the column or drop the declaration; lerobot reads None without a word",
    ),
    error("STRUCT-008", "a column is not declared", "declare it in features; lerobot refuses the dataset"),
    error(
        "STRUCT-009",
        "a column's type does not fit its declaration",
        "write the declared type: shape [1] is a bare scalar, [n] a list of n",
    ),
    error(
        "STRUCT-010",
        "values are null",
        "write values and a validity column; training stops at the first null",
    ),
    error("STRUCT-011", "rows have lists of the wrong length", "write as many values as the shape declares"),
    error(
        "STRUCT-012",
        "rows of an episode are scattered, or episodes are out of order",
        "sort rows by episode and frame",
    ),
    error(
        "STRUCT-013",
        "a count in meta/info.json differs from the data",
        "correct the count; lerobot skips or invents frames silently",
    ),
    error(
        "STRUCT-014",
        "the episode table disagrees with the data",
        "rewrite meta/episodes from the data; lookup is by position",
    ),
    warning("STRUCT-015", "the task table is inconsistent", "rewrite meta/tasks with row i for task_index i"),
    warning(
        "STRUCT-016",
        "a feature is declared in a way readers stumble over",
        "correct the declaration in meta/info.json",
    ),
    error(
        "STRUCT-017",
        "the column index does not count rows from 0",
        "renumber: index is the global row, frame_index begins at 0 in each episode",
    ),
    error(
        "STRUCT-018",
        "the column frame_index does not count rows of the episode",
        "renumber frame_index; a hole usually means that rows were lost",
    ),
    error("STRUCT-019", "a task_index is not in the task table", "add the task or correct the rows"),
    warning(
        "STRUCT-020",
        "meta/stats.json does not describe the data",
        "compute it again: gawm-data stats DIR --write",
    ),
    error("STRUCT-021", "the folder exceeds a bound of the reader", "split the dataset"),
    warning("STRUCT-022", "an episode has no rows or just one", "remove the episode"),
    error("TIME-001", "rows share a time", "drop the repeated rows or repair the recorder's clock"),
    error("TIME-002", "time runs backward", "sort the rows or split the episode where the clock was reset"),
    warning("TIME-003", "time is missing between rows", "split the episode at the gap or mask it"),
    warning(
        "TIME-004",
        "timestamp is not frame_index / fps",
        "write frame_index / fps and keep the true time in a column of its own",
    ),
    warning("TIME-005", "the clock drifts against the declared rate", "declare the true rate or resample"),
    error("TIME-006", "the rate is not the declared one", "correct fps or resample"),
    warning("TIME-007", "time between rows jitters", "resample onto a regular grid"),
    warning(
        "TIME-008",
        "time is squeezed: rows are missing although they are numbered without a gap",
        "split the episode where rows were dropped",
    ),
    warning(
        "TIME-009",
        "rows repeat the one before in the middle of motion",
        "find the stream that stalled; drop the rows or split",
    ),
    error(
        "TIME-010",
        "a row uses a sample from its own future",
        "align causally (asof) or note that the dataset is not causal",
    ),
    warning("TIME-011", "samples are stale", "give the stream a tolerance so that gaps are split or masked"),
    warning(
        "TIME-012",
        "a stream's clock drifts against the log's",
        "align by arrival time, or correct the clock",
    ),
    warning(
        "TIME-013",
        "a stream's stamps and the log's times are far apart",
        "check the clock of the sensor; give offset_ms",
    ),
    error("TIME-014", "a time is not finite", "write frame_index / fps"),
    error(
        "IMAGE-001",
        "a frame cannot be decoded",
        "drop the episode or split it there; training stops at this frame",
    ),
    error("IMAGE-002", "a frame is missing", "hold the last frame with validity false, or split"),
    error("IMAGE-003", "a frame has another size than declared", "resize it or correct the declaration"),
    warning("IMAGE-004", "frames are black", "check the camera and drop the rows"),
    warning("IMAGE-005", "frames are white", "check the exposure and drop the rows"),
    warning(
        "IMAGE-006",
        "the picture is frozen while the robot moves",
        "split the episode there; find the stalled camera",
    ),
    warning("IMAGE-007", "frames repeat earlier ones", "find out why frames come twice; drop or split"),
    warning(
        "IMAGE-008",
        "a frame differs from both its neighbours",
        "look at it: a torn, foreign or corrupted frame",
    ),
    warning("IMAGE-009", "the cameras of an episode are exchanged", "relabel the cameras of this episode"),
    warning(
        "IMAGE-010",
        "brightness or contrast of an episode is far from the others",
        "look at the episode",
    ),
    error("IMAGE-011", "a video file is missing", "copy the dataset again, or drop the feature"),
    error("IMAGE-012", "a video file is damaged", "copy the file again or encode it anew"),
    error("IMAGE-013", "a video has another number of frames than its rows", "encode one frame per row"),
    warning("IMAGE-014", "a video's size differs from the declaration", "correct the declaration"),
    warning("IMAGE-015", "video frames are off the grid of the rows", "encode at a constant rate of fps"),
    warning(
        "IMAGE-016",
        "an episode's picture lags the robot otherwise than in the others",
        "shift the camera by the lag, or drop the episode",
    ),
    warning(
        "IMAGE-017",
        "the picture jumps while the robot does not",
        "look at both frames: rows of another moment or camera, or lost frames",
    ),
    warning(
        "IMAGE-018",
        "a camera's picture is turned or mirrored against the other episodes",
        "turn the pictures of this episode, or leave it out",
    ),
    warning("IMAGE-019", "two cameras show the same frames", "find the stream that was mapped twice"),
    warning(
        "IMAGE-020",
        "an episode has the frames of another one",
        "find the frames that belong to it, or leave the episode out",
    ),
    warning(
        "IMAGE-021",
        "an episode's picture is unlike those of the other episodes",
        "look at the episode: its camera may have been moved or refocused",
    ),
    error(
        "VALUE-001",
        "values are NaN or infinite",
        "split or mask there; training loss is NaN from the first step",
    ),
    info("VALUE-002", "a dim never changes in the whole dataset", "drop it, or leave it out of the loss"),
    warning(
        "VALUE-003",
        "a signal is stuck while the robot moves",
        "split the episode there; check the sensor",
    ),
    warning(
        "VALUE-004",
        "a signal is saturated",
        "check limits and ranges; clipped values carry no information",
    ),
    warning("VALUE-005", "a signal jumps", "split at the jump, or repair the single row"),
    warning(
        "VALUE-006",
        "values look like degrees under a radian label",
        "convert to radians or correct the unit",
    ),
    warning(
        "VALUE-007",
        "an angle wraps although it is declared linear",
        "declare it as angle with its wrap, or unwrap it",
    ),
    warning(
        "VALUE-008",
        "quaternions are not of unit length",
        "normalise them; check the order of components",
    ),
    warning(
        "VALUE-009",
        "quaternions flip their sign",
        "keep the sign continuous or encode rotations as 6-D",
    ),
    warning("VALUE-010", "sine and cosine do not lie on the unit circle", "encode the angle anew"),
    warning("VALUE-011", "6-D rotations or matrices are not orthonormal", "encode the rotation anew"),
    warning("VALUE-012", "values lie outside their declared limits", "check unit, zero and limits"),
    warning(
        "VALUE-013",
        "an episode's values are on another scale than the others'",
        "check the unit of this episode",
    ),
    warning("VALUE-014", "a truth value is neither 0 nor 1", "write 0 and 1"),
    warning(
        "VALUE-015",
        "a signal is much noisier than elsewhere",
        "look at the interval; check the sensor and its cable",
    ),
    warning(
        "VALUE-016",
        "an episode's values are offset from the others'",
        "check the calibration of this episode",
    ),
    info("VALUE-017", "two dims are always equal", "drop one of them"),
    warning("VALUE-018", "a signal drops to zero for single rows", "repair the rows; a reading failed"),
    warning(
        "VALUE-019",
        "a signal is coarser than in the other episodes",
        "check resolution and rate of the sensor in this episode",
    ),
    warning(
        "VALUE-020",
        "a quaternion's components are in another order than in the other episodes",
        "reorder them: the order must be declared once and kept",
    ),
    warning(
        "SEMANTIC-001",
        "actions are shifted in time against the state",
        "shift them so that the action of row t acts between t and t+1",
    ),
    warning(
        "SEMANTIC-002",
        "actions and states name their joints in different orders",
        "reorder the dims of one of them",
    ),
    warning(
        "SEMANTIC-003",
        "actions look like differences where positions are meant",
        "integrate them, or label them as deltas",
    ),
    warning(
        "SEMANTIC-004",
        "a dim that moves in other episodes is constant in this one",
        "check that the signal was connected",
    ),
    warning(
        "SEMANTIC-005",
        "actions do not explain the state's motion",
        "check that action and state belong together",
    ),
    warning("SEMANTIC-006", "a task text is missing or says nothing", "describe the task in a sentence"),
    warning("SEMANTIC-007", "an action has the opposite sign of its state", "correct the sign"),
    warning(
        "SEMANTIC-008",
        "an action is on another scale than its state",
        "convert one of the two to the other's unit",
    ),
    info("SEMANTIC-009", "no episode says whether it succeeded", "add a column success to meta/episodes"),
    info("SEMANTIC-010", "names of action and state dims differ", "use the same names for the same joints"),
    info("SEMANTIC-011", "much of an episode is idle", "trim it: gawm-data trim"),
    warning(
        "SEMANTIC-012",
        "nothing in the pictures shows this target",
        "do not ask the model to see it, or check the cameras",
    ),
    warning(
        "SEMANTIC-013",
        "few training windows survive",
        "shorten the window or repair the episodes that lose most",
    ),
    warning(
        "SEMANTIC-014",
        "the offset between action and state differs from the other episodes",
        "check the zero of this joint",
    ),
    warning(
        "SEMANTIC-015",
        "states follow their actions at another rate than in the other episodes",
        "look for rows that are missing or repeated throughout, or for another rate",
    ),
    warning(
        "SEMANTIC-016",
        "a signal is not related to the others as in the other episodes",
        "check time, sign, unit, zero and place of this dim in this episode, and of those it depends on",
    ),
    warning("SPLIT-001", "two episodes are the same", "remove one of them"),
    warning(
        "SPLIT-002",
        "two episodes are nearly the same",
        "remove one of them, or keep both on one side of the split",
    ),
    error(
        "SPLIT-003",
        "one session is on both sides of a split",
        "split by session: gawm-data split --by session",
    ),
    error(
        "SPLIT-004",
        "a split names episodes that do not exist, or its text is no range",
        "correct splits in meta/info.json",
    ),
    warning("SPLIT-005", "splits overlap", "give each episode to one split"),
    error(
        "SPLIT-006",
        "the same episode is on both sides of a split",
        "remove one of them or put both on one side",
    ),
    warning("SPLIT-007", "equal episodes have different labels", "decide which label is right"),
    warning(
        "SPLIT-008",
        "episodes share stretches of rows",
        "the recording was cut twice: remove the overlap",
    ),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_unique_and_sorted_within_groups() {
        for pair in RULES.windows(2) {
            let group = |code: &'static str| code.split('-').next().unwrap_or("");
            if group(pair[0].code) == group(pair[1].code) {
                assert!(pair[0].code < pair[1].code, "{} {}", pair[0].code, pair[1].code);
            }
        }
        assert!(rule("TIME-003").is_some());
    }
}
