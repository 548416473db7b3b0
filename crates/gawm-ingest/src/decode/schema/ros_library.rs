//! Definitions of common ROS types, for channels without a schema, and folders of .msg files that a user gives.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::ros_msg::{Dialect, Fault, canonical, check_text};

/// Largest .msg file that is read.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// Most files that one folder may hold.
const MAX_FILES: usize = 20_000;

/// Deepest folder below a schema folder that is searched.
const MAX_FOLDER_DEPTH: usize = 8;

/// ROS message definitions by type name (`pkg/Type`).
#[derive(Clone, Debug, Default)]
pub(crate) struct Library {
    types: BTreeMap<String, String>,
}

/// Why a schema folder cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SchemaFolderError {
    /// The folder or a file in it cannot be read.
    #[error("cannot read schema folder {path:?}: {source}")]
    Read {
        /// The folder or file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A .msg file is no message definition.
    #[error("{path:?} is not a message definition: {detail}")]
    BadDefinition {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        detail: String,
    },
    /// The folder holds no .msg file, or far too many files.
    #[error("schema folder {path:?}: expected 1 to {MAX_FILES} .msg files, got {got}")]
    Count {
        /// The folder.
        path: PathBuf,
        /// Files found.
        got: usize,
    },
}

impl Library {
    /// Returns the types that gawm knows without being told.
    pub(crate) fn builtin() -> Self {
        let types = BUILTIN.iter().map(|(name, text)| ((*name).to_owned(), (*text).to_owned())).collect();
        Self { types }
    }

    /// Returns the definition of `pkg/Type`.
    pub(crate) fn find(&self, name: &str, dialect: Dialect) -> Option<&str> {
        if dialect == Dialect::Ros1 {
            match name {
                "std_msgs/Header" => return Some("uint32 seq\ntime stamp\nstring frame_id\n"),
                "sensor_msgs/CameraInfo" => return Some(ROS1_CAMERA_INFO),
                _ => {}
            }
        }
        self.types.get(name).map(String::as_str)
    }

    /// Adds every `<package>/msg/<Type>.msg` or `<package>/<Type>.msg` below `folder`.
    pub(crate) fn add_folder(&mut self, folder: &Path) -> Result<(), SchemaFolderError> {
        let mut files = Vec::new();
        collect(folder, 0, &mut files)?;
        if files.is_empty() || files.len() > MAX_FILES {
            return Err(SchemaFolderError::Count { path: folder.to_owned(), got: files.len() });
        }
        files.sort();
        for path in files {
            let (name, text) = read_definition(folder, &path)?;
            self.types.insert(name, text);
        }
        Ok(())
    }
}

fn collect(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) -> Result<(), SchemaFolderError> {
    let wrap = |source| SchemaFolderError::Read { path: folder.to_owned(), source };
    for entry in std::fs::read_dir(folder).map_err(wrap)? {
        let path = entry.map_err(wrap)?.path();
        if path.is_dir() && depth < MAX_FOLDER_DEPTH {
            collect(&path, depth + 1, files)?;
        } else if path.extension().is_some_and(|e| e == "msg") && files.len() <= MAX_FILES {
            files.push(path);
        }
    }
    Ok(())
}

fn read_definition(folder: &Path, path: &Path) -> Result<(String, String), SchemaFolderError> {
    let wrap = |source| SchemaFolderError::Read { path: path.to_owned(), source };
    let bad = |detail: String| SchemaFolderError::BadDefinition { path: path.to_owned(), detail };
    let size = std::fs::metadata(path).map_err(wrap)?.len();
    if size > MAX_FILE_BYTES {
        return Err(bad(format!("expected at most {MAX_FILE_BYTES} bytes, got {size}")));
    }
    let data = std::fs::read(path).map_err(wrap)?;
    let stem =
        path.file_stem().and_then(|s| s.to_str()).ok_or_else(|| bad("its name is not UTF-8".into()))?;
    let parent = path.parent().unwrap_or(folder);
    let package_dir = if parent.file_name().is_some_and(|n| n == "msg") {
        parent.parent().unwrap_or(parent)
    } else {
        parent
    };
    let package = std::path::absolute(package_dir)
        .ok()
        .and_then(|p| p.file_name().and_then(|n| n.to_str()).map(str::to_owned))
        .ok_or_else(|| bad("it lies in no package folder".into()))?;
    let name = canonical(&format!("{package}/{stem}"));
    check_text(&name, &data).map_err(|fault| bad(describe(&fault)))?;
    let text = String::from_utf8(data).map_err(|e| bad(e.to_string()))?;
    Ok((name, text))
}

/// Puts a fault of a definition into words.
pub(crate) fn describe(fault: &Fault) -> String {
    match fault {
        Fault::NotText { offset } => format!("it is not UTF-8 text (byte {offset})"),
        Fault::Service => "it is a service or action definition (holds \"---\")".to_owned(),
        Fault::Line { line, text, expected } => format!("line {line}: expected {expected}, got {text:?}"),
        Fault::UnknownType { field, type_name } => {
            format!("field {field:?} has the unknown type {type_name:?}")
        }
        Fault::Recursive { type_name } => format!("type {type_name:?} contains itself"),
        Fault::TooLarge => "expected at most 48 levels of types and 50000 fields".to_owned(),
    }
}

const ROS1_CAMERA_INFO: &str = "Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] D\n\
float64[9] K\nfloat64[9] R\nfloat64[12] P\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi\n";

const BUILTIN: &[(&str, &str)] = &[
    ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
    ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    ("std_msgs/Empty", ""),
    ("std_msgs/Bool", "bool data\n"),
    ("std_msgs/Byte", "byte data\n"),
    ("std_msgs/Char", "char data\n"),
    ("std_msgs/String", "string data\n"),
    ("std_msgs/Int8", "int8 data\n"),
    ("std_msgs/UInt8", "uint8 data\n"),
    ("std_msgs/Int16", "int16 data\n"),
    ("std_msgs/UInt16", "uint16 data\n"),
    ("std_msgs/Int32", "int32 data\n"),
    ("std_msgs/UInt32", "uint32 data\n"),
    ("std_msgs/Int64", "int64 data\n"),
    ("std_msgs/UInt64", "uint64 data\n"),
    ("std_msgs/Float32", "float32 data\n"),
    ("std_msgs/Float64", "float64 data\n"),
    ("std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n"),
    ("std_msgs/MultiArrayDimension", "string label\nuint32 size\nuint32 stride\n"),
    ("std_msgs/MultiArrayLayout", "MultiArrayDimension[] dim\nuint32 data_offset\n"),
    ("std_msgs/ByteMultiArray", "MultiArrayLayout layout\nbyte[] data\n"),
    ("std_msgs/Int8MultiArray", "MultiArrayLayout layout\nint8[] data\n"),
    ("std_msgs/UInt8MultiArray", "MultiArrayLayout layout\nuint8[] data\n"),
    ("std_msgs/Int16MultiArray", "MultiArrayLayout layout\nint16[] data\n"),
    ("std_msgs/UInt16MultiArray", "MultiArrayLayout layout\nuint16[] data\n"),
    ("std_msgs/Int32MultiArray", "MultiArrayLayout layout\nint32[] data\n"),
    ("std_msgs/UInt32MultiArray", "MultiArrayLayout layout\nuint32[] data\n"),
    ("std_msgs/Int64MultiArray", "MultiArrayLayout layout\nint64[] data\n"),
    ("std_msgs/UInt64MultiArray", "MultiArrayLayout layout\nuint64[] data\n"),
    ("std_msgs/Float32MultiArray", "MultiArrayLayout layout\nfloat32[] data\n"),
    ("std_msgs/Float64MultiArray", "MultiArrayLayout layout\nfloat64[] data\n"),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Point32", "float32 x\nfloat32 y\nfloat32 z\n"),
    ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"),
    ("geometry_msgs/Pose", "Point position\nQuaternion orientation\n"),
    ("geometry_msgs/Pose2D", "float64 x\nfloat64 y\nfloat64 theta\n"),
    ("geometry_msgs/Transform", "Vector3 translation\nQuaternion rotation\n"),
    ("geometry_msgs/Twist", "Vector3 linear\nVector3 angular\n"),
    ("geometry_msgs/Accel", "Vector3 linear\nVector3 angular\n"),
    ("geometry_msgs/Wrench", "Vector3 force\nVector3 torque\n"),
    ("geometry_msgs/PoseWithCovariance", "Pose pose\nfloat64[36] covariance\n"),
    ("geometry_msgs/TwistWithCovariance", "Twist twist\nfloat64[36] covariance\n"),
    ("geometry_msgs/AccelWithCovariance", "Accel accel\nfloat64[36] covariance\n"),
    ("geometry_msgs/Vector3Stamped", "std_msgs/Header header\nVector3 vector\n"),
    ("geometry_msgs/PointStamped", "std_msgs/Header header\nPoint point\n"),
    ("geometry_msgs/QuaternionStamped", "std_msgs/Header header\nQuaternion quaternion\n"),
    ("geometry_msgs/PoseStamped", "std_msgs/Header header\nPose pose\n"),
    ("geometry_msgs/PoseArray", "std_msgs/Header header\nPose[] poses\n"),
    ("geometry_msgs/PoseWithCovarianceStamped", "std_msgs/Header header\nPoseWithCovariance pose\n"),
    (
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\nTransform transform\n",
    ),
    ("geometry_msgs/TwistStamped", "std_msgs/Header header\nTwist twist\n"),
    ("geometry_msgs/TwistWithCovarianceStamped", "std_msgs/Header header\nTwistWithCovariance twist\n"),
    ("geometry_msgs/AccelStamped", "std_msgs/Header header\nAccel accel\n"),
    ("geometry_msgs/WrenchStamped", "std_msgs/Header header\nWrench wrench\n"),
    ("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms\n"),
    ("tf/tfMessage", "geometry_msgs/TransformStamped[] transforms\n"),
    (
        "sensor_msgs/JointState",
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
    ),
    (
        "sensor_msgs/MultiDOFJointState",
        "std_msgs/Header header\nstring[] joint_names\ngeometry_msgs/Transform[] transforms\n\
         geometry_msgs/Twist[] twist\ngeometry_msgs/Wrench[] wrench\n",
    ),
    (
        "sensor_msgs/Image",
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n",
    ),
    ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n"),
    (
        "sensor_msgs/RegionOfInterest",
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
    ),
    (
        "sensor_msgs/CameraInfo",
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n\
         float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi\n",
    ),
    (
        "sensor_msgs/Imu",
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n\
         geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n\
         geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    ),
    (
        "sensor_msgs/MagneticField",
        "std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\nfloat64[9] magnetic_field_covariance\n",
    ),
    ("sensor_msgs/Joy", "std_msgs/Header header\nfloat32[] axes\nint32[] buttons\n"),
    // No sensor_msgs/Range: its fields differ between releases.
    ("sensor_msgs/Temperature", "std_msgs/Header header\nfloat64 temperature\nfloat64 variance\n"),
    (
        "sensor_msgs/LaserScan",
        "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\nfloat32 time_increment\n\
         float32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities\n",
    ),
    (
        "nav_msgs/Odometry",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
         geometry_msgs/TwistWithCovariance twist\n",
    ),
    ("nav_msgs/Path", "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n"),
    (
        "trajectory_msgs/JointTrajectoryPoint",
        "float64[] positions\nfloat64[] velocities\nfloat64[] accelerations\nfloat64[] effort\n\
         builtin_interfaces/Duration time_from_start\n",
    ),
    (
        "trajectory_msgs/JointTrajectory",
        "std_msgs/Header header\nstring[] joint_names\nJointTrajectoryPoint[] points\n",
    ),
    ("control_msgs/GripperCommand", "float64 position\nfloat64 max_effort\n"),
    (
        "control_msgs/JointTrajectoryControllerState",
        "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint desired\n\
         trajectory_msgs/JointTrajectoryPoint actual\ntrajectory_msgs/JointTrajectoryPoint error\n",
    ),
    (
        "control_msgs/JointJog",
        "std_msgs/Header header\nstring[] joint_names\nfloat64[] displacements\nfloat64[] velocities\nfloat64 duration\n",
    ),
    ("control_msgs/InterfaceValue", "string[] interface_names\nfloat64[] values\n"),
    (
        "control_msgs/DynamicJointState",
        "std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values\n",
    ),
];
