//! The few ROS 2 messages that a log holds, as CDR (XCDR1, little-endian), with their definitions.

/// Begins every payload: plain CDR, little-endian.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

const TIME_AND_HEADER: &str = "\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";

/// A message type: its name and the text of its definition with all that it uses (`ros2msg`).
#[derive(Clone, Copy, Debug)]
pub(super) enum MessageType {
    CompressedImage,
    PointStamped,
    Vector3Stamped,
    String,
}

impl MessageType {
    pub(super) fn name(self) -> &'static str {
        match self {
            MessageType::CompressedImage => "sensor_msgs/msg/CompressedImage",
            MessageType::PointStamped => "geometry_msgs/msg/PointStamped",
            MessageType::Vector3Stamped => "geometry_msgs/msg/Vector3Stamped",
            MessageType::String => "std_msgs/msg/String",
        }
    }

    pub(super) fn definition(self) -> String {
        let three = "float64 x\nfloat64 y\nfloat64 z\n";
        let line = "=".repeat(80);
        match self {
            MessageType::CompressedImage => {
                format!("std_msgs/Header header\nstring format\nuint8[] data\n{TIME_AND_HEADER}")
            }
            MessageType::PointStamped => format!(
                "std_msgs/Header header\ngeometry_msgs/Point point\n{line}\nMSG: geometry_msgs/Point\n{three}{TIME_AND_HEADER}"
            ),
            MessageType::Vector3Stamped => format!(
                "std_msgs/Header header\ngeometry_msgs/Vector3 vector\n{line}\nMSG: geometry_msgs/Vector3\n{three}{TIME_AND_HEADER}"
            ),
            MessageType::String => "string data\n".to_owned(),
        }
    }
}

/// Writes one message at a time into a buffer that it keeps.
#[derive(Debug, Default)]
pub(super) struct CdrEncoder {
    buffer: Vec<u8>,
}

impl CdrEncoder {
    /// A `sensor_msgs/msg/CompressedImage`.
    pub(super) fn compressed_image(&mut self, stamp_ns: u64, format: &str, data: &[u8]) {
        self.begin();
        self.header(stamp_ns, "camera");
        self.string(format);
        self.u32(data.len() as u32);
        self.buffer.extend_from_slice(data);
    }

    /// A `geometry_msgs/msg/PointStamped` or `Vector3Stamped` in the plane: both have the same layout.
    pub(super) fn planar(&mut self, stamp_ns: u64, xy: [f32; 2]) {
        self.begin();
        self.header(stamp_ns, "world");
        for value in [f64::from(xy[0]), f64::from(xy[1]), 0.0] {
            self.align(8);
            self.buffer.extend_from_slice(&value.to_le_bytes());
        }
    }

    /// A `std_msgs/msg/String`.
    pub(super) fn text(&mut self, text: &str) {
        self.begin();
        self.string(text);
    }

    /// The message written last.
    pub(super) fn encoded(&self) -> &[u8] {
        &self.buffer
    }

    fn begin(&mut self) {
        self.buffer.clear();
        self.buffer.extend_from_slice(&ENCAPSULATION);
    }

    fn header(&mut self, stamp_ns: u64, frame_id: &str) {
        self.u32((stamp_ns / 1_000_000_000) as u32);
        self.u32((stamp_ns % 1_000_000_000) as u32);
        self.string(frame_id);
    }

    fn string(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.buffer.extend_from_slice(text.as_bytes());
        self.buffer.push(0);
    }

    fn u32(&mut self, value: u32) {
        self.align(4);
        self.buffer.extend_from_slice(&value.to_le_bytes());
    }

    /// Alignment counts from the end of the encapsulation header.
    fn align(&mut self, to: usize) {
        let misaligned = (self.buffer.len() - ENCAPSULATION.len()) % to;
        if misaligned != 0 {
            self.buffer.resize(self.buffer.len() + to - misaligned, 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planar_has_the_layout_of_the_standard() {
        let mut encoder = CdrEncoder::default();
        encoder.planar(5_000_000_007, [1.5, -2.0]);
        let mut expected = vec![0, 1, 0, 0, 5, 0, 0, 0, 7, 0, 0, 0, 6, 0, 0, 0];
        expected.extend_from_slice(b"world\0");
        expected.extend_from_slice(&[0, 0, 0, 0, 0, 0]); // 18 to 24, the alignment of a double
        for value in [1.5_f64, -2.0, 0.0] {
            expected.extend_from_slice(&value.to_le_bytes());
        }
        assert_eq!(encoder.encoded(), expected);
    }
}
