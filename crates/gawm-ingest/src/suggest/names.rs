//! What the names of topics and fields say.

/// Returns the words of a name, in lower case: `/arm/JointCommand_2` gives arm, joint, command, 2.
pub(crate) fn words(name: &str) -> Vec<String> {
    let mut words = Vec::new();
    let mut word = String::new();
    let mut was_lower = false;
    for char in name.chars() {
        let is_break = !char.is_alphanumeric() || (char.is_uppercase() && was_lower);
        if is_break && !word.is_empty() {
            words.push(std::mem::take(&mut word));
        }
        if char.is_alphanumeric() {
            word.extend(char.to_lowercase());
        }
        was_lower = char.is_lowercase() || char.is_numeric();
    }
    if !word.is_empty() {
        words.push(word);
    }
    words
}

/// Returns whether a name says that a quaternion begins with its real part.
pub(crate) fn says_wxyz(name: &str) -> bool {
    has(name, &["wxyz"])
}

fn has(name: &str, wanted: &[&str]) -> bool {
    words(name).iter().any(|word| wanted.contains(&word.as_str()))
}

/// Words that commands go by.
const COMMAND: [&str; 15] = [
    "command",
    "commands",
    "cmd",
    "cmds",
    "action",
    "actions",
    "target",
    "targets",
    "setpoint",
    "setpoints",
    "desired",
    "goal",
    "reference",
    "ctrl",
    "control",
];

pub(crate) fn is_command(name: &str) -> bool {
    has(name, &COMMAND)
}

/// Types that are sent to make a robot move.
pub(crate) fn is_command_type(type_name: &str) -> bool {
    let bare = type_name.rsplit(['/', '.']).next().unwrap_or("");
    is_command(bare)
        || matches!(bare, "JointTrajectory" | "JointJog" | "AckermannDrive" | "AckermannDriveStamped")
}

pub(crate) fn is_gripper(name: &str) -> bool {
    has(name, &["gripper", "grippers", "finger", "fingers", "grip", "jaw", "hand"])
}

/// Returns the unit that the end of a name says: `opening_mm`, `speed_rad_s`.
pub(crate) fn unit_of(path: &str) -> Option<&'static str> {
    let name = path.trim_end_matches("[]").to_lowercase();
    let units = [
        ("_rad_s", "rad/s"),
        ("_rad_per_s", "rad/s"),
        ("_deg_s", "deg/s"),
        ("_deg_per_s", "deg/s"),
        ("_m_s2", "m/s^2"),
        ("_mps2", "m/s^2"),
        ("_m_s", "m/s"),
        ("_mps", "m/s"),
        ("_rpm", "rpm"),
        ("_mm", "mm"),
        ("_cm", "cm"),
        ("_nm", "N*m"),
        ("_m", "m"),
    ];
    units.into_iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, unit)| unit)
}

pub(crate) fn is_delta(name: &str) -> bool {
    has(name, &["delta", "deltas", "relative", "increment", "incremental"])
}

pub(crate) fn is_velocity(name: &str) -> bool {
    has(name, &["velocity", "velocities", "vel", "twist", "speed", "speeds"])
}

pub(crate) fn is_recording(name: &str) -> bool {
    let words = [
        "recording",
        "recorder",
        "record",
        "rec",
        "episode",
        "episodes",
        "trial",
        "trials",
        "demo",
        "demonstration",
        "rollout",
        "rollouts",
    ];
    has(name, &words)
}

pub(crate) fn is_reward(name: &str) -> bool {
    has(name, &["reward", "rewards", "return", "returns", "terminated", "truncated"])
}

pub(crate) fn is_task(name: &str) -> bool {
    has(name, &["task", "tasks", "instruction", "instructions", "prompt", "language", "goal_text"])
}

/// Topics of middleware that say nothing of the robot's state.
pub(crate) fn is_housekeeping(topic: &str, type_name: &str) -> bool {
    let bare = type_name.rsplit(['/', '.']).next().unwrap_or("");
    matches!(
        bare,
        "Log"
            | "ParameterEvent"
            | "WriteSplitEvent"
            | "DiagnosticArray"
            | "TFMessage"
            | "FrameTransform"
            | "FrameTransforms"
            | "CameraInfo"
            | "CameraCalibration"
            | "Clock"
            | "Statistics"
            | "Marker"
            | "MarkerArray"
            | "SceneUpdate"
            | "OccupancyGrid"
            | "PointCloud"
            | "PointCloud2"
    ) || (type_name.contains("/srv/") && bare.ends_with("_Event"))
        || topic.ends_with("/clock")
        || matches!(topic, "/rosout" | "/rosout_agg" | "/parameter_events" | "/tf" | "/tf_static")
}

/// Readings that say little of where the robot is: of what is around it, of its battery.
pub(crate) fn is_side_reading(topic: &str, type_name: &str) -> bool {
    let bare = type_name.rsplit(['/', '.']).next().unwrap_or("");
    matches!(
        bare,
        "LaserScan"
            | "MultiEchoLaserScan"
            | "Range"
            | "BatteryState"
            | "Temperature"
            | "FluidPressure"
            | "RelativeHumidity"
            | "Illuminance"
    ) || has(topic, &["battery", "temperature", "diagnostics"])
}

/// Settings of a sensor that are sent with every reading.
pub(crate) fn is_setting(type_name: &str, path: &str) -> bool {
    let bare = type_name.rsplit(['/', '.']).next().unwrap_or("");
    match bare {
        "LaserScan" => !path.starts_with("ranges") && !path.starts_with("intensities"),
        "Range" => path != "range",
        _ => false,
    }
}

/// Times, counters and labels within a message are no measurements.
pub(crate) fn is_bookkeeping(path: &str) -> bool {
    let last = path.rsplit('.').next().unwrap_or(path);
    let first = path.split(['.', '[']).next().unwrap_or(path);
    matches!(first, "header" | "stamp" | "timestamp" | "layout")
        || matches!(
            last,
            "t" | "time"
                | "sec"
                | "secs"
                | "nsec"
                | "nsecs"
                | "nanosec"
                | "nanos"
                | "seconds"
                | "seq"
                | "sequence"
                | "stamp"
                | "timestamp"
                | "id"
                | "index"
                | "frame_id"
                | "type_mask"
                | "coordinate_frame"
                | "counter"
                | "sequenceNumber"
                | "sequence_number"
                | "sequence_num"
                | "seq_num"
        )
        || path.contains("covariance")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_of_names() {
        let units = ["opening_mm", "arm.tip_m_s", "wheels_rpm[]", "Torque_Nm", "sum", "q_m"].map(unit_of);
        assert_eq!(units, [Some("mm"), Some("m/s"), Some("rpm"), Some("N*m"), None, Some("m")]);
    }

    #[test]
    fn words_of_names() {
        assert_eq!(words("/arm/JointCommand_2"), ["arm", "joint", "command", "2"]);
        assert!(
            is_command("/cell/velocity_command") && is_command("/cmd_vel") && !is_command("/recommended")
        );
        assert!(
            is_bookkeeping("header.stamp.sec") && is_bookkeeping("t") && !is_bookkeeping("pose.position.x")
        );
    }
}
