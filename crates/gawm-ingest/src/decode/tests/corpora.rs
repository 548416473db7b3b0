//! Logs of other people's writers: every channel decodes or says why not; values equal the truth files.

use std::collections::BTreeMap;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use super::super::*;
use super::shared;

/// One message of a log, with its channel.
struct Sample {
    channel: std::sync::Arc<mcap::Channel<'static>>,
    data: Vec<u8>,
    log_time_ns: u64,
}

/// Reads the messages of an undamaged log, in log-time order.
fn messages(path: &Path) -> Vec<Sample> {
    let bytes = std::fs::read(path).unwrap();
    let mut out: Vec<Sample> = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(|m| m.unwrap())
        .map(|m| Sample {
            channel: std::sync::Arc::new(mcap::Channel {
                id: m.channel.id,
                topic: m.channel.topic.clone(),
                schema: m.channel.schema.as_ref().map(|s| {
                    std::sync::Arc::new(mcap::Schema {
                        id: s.id,
                        name: s.name.clone(),
                        encoding: s.encoding.clone(),
                        data: s.data.to_vec().into(),
                    })
                }),
                message_encoding: m.channel.message_encoding.clone(),
                metadata: m.channel.metadata.clone(),
            }),
            data: m.data.to_vec(),
            log_time_ns: m.log_time,
        })
        .collect();
    out.sort_by_key(|m| m.log_time_ns);
    out
}

fn schema_of<'a>(channel: &'a mcap::Channel<'static>) -> ChannelSchema<'a> {
    let schema = channel.schema.as_deref();
    ChannelSchema {
        topic: &channel.topic,
        message_encoding: &channel.message_encoding,
        schema_name: schema.map_or("", |s| &s.name),
        schema_encoding: schema.map_or("", |s| &s.encoding),
        schema_data: schema.map_or(&[], |s| &s.data),
    }
}

fn logs_below(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && path.file_name().is_some_and(|n| n != "mcap_conformance") {
            logs_below(&path, out);
        } else if path.extension().is_some_and(|e| e == "mcap") {
            out.push(path);
        }
    }
}

#[test]
fn every_channel_decodes_or_says_why_not() {
    let Some(shared) = shared() else { return };
    let corpora = shared.join("corpora");
    let mut logs = Vec::new();
    logs_below(&corpora, &mut logs);
    logs.sort();
    let library = SchemaLibrary::builtin();
    let mut refused: BTreeMap<String, String> = BTreeMap::new();
    let (mut n_channels, mut n_messages) = (0, 0);
    for path in &logs {
        let name = path.strip_prefix(&corpora).unwrap().display().to_string();
        let Ok(bytes) = std::fs::read(path) else { continue };
        let Ok(stream) = mcap::MessageStream::new(&bytes) else { continue };
        let mut seen: BTreeMap<u16, usize> = BTreeMap::new();
        for message in stream {
            let Ok(message) = message else { break };
            let n = seen.entry(message.channel.id).or_default();
            *n += 1;
            n_channels += usize::from(*n == 1);
            if *n > 20 {
                continue;
            }
            let schema = message.channel.schema.as_deref();
            let channel = ChannelSchema {
                topic: &message.channel.topic,
                message_encoding: &message.channel.message_encoding,
                schema_name: schema.map_or("", |s| &s.name),
                schema_encoding: schema.map_or("", |s| &s.encoding),
                schema_data: schema.map_or(&[], |s| &s.data),
            };
            let unpacked = is_compressed_message(&message.data)
                .then(|| decompress_message(&message.data, 1 << 24).unwrap());
            let data = unpacked.as_deref().unwrap_or(&message.data);
            n_messages += 1;
            if let Err(e) = decode_to_json_limited(&channel, data, &library, 16) {
                refused.entry(format!("{name} {}", channel.topic)).or_insert(format!("{}: {e}", e.reason()));
            }
        }
    }
    let got: Vec<&str> = refused.keys().map(String::as_str).collect();
    for (channel, reason) in &refused {
        eprintln!("{channel}: {reason}");
    }
    let expected = [
        "generated/bad_schema_garbage.mcap /tf",
        "generated/bad_schema_garbage.mcap /tf_static",
        "plotjuggler/test_bad_schema.mcap /bad/data",
        // Its writer counts alignment from the encapsulation header; no other reader takes it either.
        "plotjuggler/test_embedded_timestamp.mcap /stamped/value",
        "plotjuggler/test_sample_0_6.mcap channelA",
        "plotjuggler/test_sample_0_6.mcap channelB",
        "rosbag2/only_services.mcap /add_two_ints/_service_event",
    ];
    assert_eq!(got, expected);
    assert!(n_channels > 300 && n_messages > 4000, "{n_channels} channels, {n_messages} messages");
}

/// A column of a truth file.
struct Truth {
    bytes: Vec<u8>,
}

impl Truth {
    fn load(path: &Path) -> BTreeMap<String, Self> {
        let mut archive = zip::ZipArchive::new(std::fs::File::open(path).unwrap()).unwrap();
        let mut out = BTreeMap::new();
        for i in 0..archive.len() {
            let mut file = archive.by_index(i).unwrap();
            let name = file.name().unwrap().trim_end_matches(".npy").to_owned();
            let mut raw = Vec::new();
            file.read_to_end(&mut raw).unwrap();
            // Version 1.0: the length of the header stands behind the magic and the version.
            assert_eq!(raw[..8], *b"\x93NUMPY\x01\0", "{name}");
            let header = 10 + usize::from(u16::from_le_bytes([raw[8], raw[9]]));
            out.insert(name, Self { bytes: raw[header..].to_vec() });
        }
        out
    }

    fn f64(&self) -> Vec<f64> {
        self.bytes.chunks_exact(8).map(|c| f64::from_le_bytes(c.try_into().unwrap())).collect()
    }

    fn i64(&self) -> Vec<i64> {
        self.bytes.chunks_exact(8).map(|c| i64::from_le_bytes(c.try_into().unwrap())).collect()
    }
}

/// Decodes one topic; returns the values row-major, and the stamps (0 = none).
fn decode_topic(log: &[Sample], topic: &str, fields: &[&str]) -> (Vec<f64>, Vec<i64>) {
    let fields: Vec<FieldPath> = fields.iter().map(|f| f.parse().unwrap()).collect();
    let library = SchemaLibrary::builtin();
    let mut plans: BTreeMap<u16, DecodePlan> = BTreeMap::new();
    let mut sink = RowSink::new();
    let mut stamps = Vec::new();
    for sample in log.iter().filter(|s| s.channel.topic == topic) {
        let plan = plans
            .entry(sample.channel.id)
            .or_insert_with(|| DecodePlan::compile(&schema_of(&sample.channel), &fields, &library).unwrap());
        match plan.decode(&sample.data, &mut sink).unwrap() {
            Decoded::Row { stamp_ns } => stamps.push(stamp_ns.unwrap_or(0)),
            Decoded::NotInMessage { .. } => panic!("an element is missing"),
        }
    }
    (sink.take(), stamps)
}

/// Asserts equality and shows the first difference only.
fn check_same(got: &[f64], expected: &[f64], name: &str) {
    assert_eq!(got.len(), expected.len(), "{name}");
    let differs = got.iter().zip(expected).position(|(a, b)| a != b);
    assert_eq!(differs.map(|i| (i, got[i], expected[i])), None, "{name}");
}

#[test]
fn arm_logs_equal_their_truth_in_every_encoding() {
    let Some(shared) = shared() else { return };
    let folder = shared.join("corpora/generated");
    let truth = Truth::load(&folder.join("truth/arm.npz"));
    let by_name: Vec<String> = (1..=6).map(|i| format!("position[name=\"joint_{i}\"]")).collect();
    let by_member: Vec<String> = (1..=6).map(|i| format!("joints[name=\"joint_{i}\"].position")).collect();
    let command = ["data[0:7]"];
    for (file, joints) in [
        ("arm_ros2_zstd.mcap", &by_name),
        ("arm_ros2_unchunked.mcap", &by_name),
        ("arm_json_lz4.mcap", &by_name),
        ("arm_protobuf.mcap", &by_member),
    ] {
        let log = messages(&folder.join(file));
        let joints: Vec<&str> = joints.iter().map(String::as_str).collect();
        let (values, stamps) = decode_topic(&log, "/joint_states", &joints);
        check_same(&values, &truth["joint_position"].f64(), file);
        assert_eq!(stamps, truth["joint_stamp"].i64(), "{file}");
        let is_proto = file == "arm_protobuf.mcap";
        let fields: &[&str] = if is_proto { &["values[0:7]"] } else { &command };
        let fields = command_fields(&log, fields);
        let (values, _) =
            decode_topic(&log, "/arm/command", &fields.iter().map(String::as_str).collect::<Vec<_>>());
        let mut expected = truth["action"].f64();
        if is_proto {
            // This writer's gripper is a 32-bit float.
            expected.iter_mut().skip(6).step_by(7).for_each(|v| *v = f64::from(*v as f32));
        }
        check_same(&values, &expected, file);
        check_images(&log, &truth, file);
    }
}

/// The protobuf command's field names come from its own schema.
fn command_fields(log: &[Sample], fallback: &[&str]) -> Vec<String> {
    let sample = log.iter().find(|s| s.channel.topic == "/arm/command").unwrap();
    if sample.channel.message_encoding != "protobuf" {
        return fallback.iter().map(|s| (*s).to_owned()).collect();
    }
    let fields = channel_fields(&schema_of(&sample.channel), &SchemaLibrary::builtin()).unwrap();
    let mut out = Vec::new();
    for field in fields.iter().filter(|f| f.scalar == Some(Scalar::F64)) {
        out.push(match field.path.strip_suffix("[]") {
            Some(array) => format!("{array}[0:6]"),
            None => field.path.clone(),
        });
    }
    out
}

fn check_images(log: &[Sample], truth: &BTreeMap<String, Truth>, file: &str) {
    let library = SchemaLibrary::builtin();
    let mut sink = RowSink::new();
    let mut stamps = Vec::new();
    for sample in log.iter().filter(|s| s.channel.topic == "/camera/image/compressed") {
        let plan = ImagePlan::compile(&schema_of(&sample.channel), &library).unwrap();
        let image = plan.extract(&sample.data, &mut sink).unwrap();
        assert!(image.data.starts_with(&[0xff, 0xd8, 0xff]), "{file}");
        assert_eq!(image.format, "jpeg");
        stamps.push(image.stamp_ns.unwrap_or(0));
    }
    assert_eq!(stamps, truth["image_stamp"].i64(), "{file}");
}

#[test]
fn cell_log_equals_its_truth() {
    let Some(shared) = shared() else { return };
    let folder = shared.join("corpora/cell");
    let truth = Truth::load(&folder.join("truth/cell.npz"));
    let log = messages(&folder.join("cell_mixed_zstd.mcap"));
    let joints = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"];
    for (arm, stream) in [("left", "joint_a"), ("right", "joint_b")] {
        for quantity in ["position", "velocity", "effort"] {
            let fields: Vec<String> =
                joints.iter().map(|j| format!("{quantity}[name=\"{arm}_{j}\"]")).collect();
            let fields: Vec<&str> = fields.iter().map(String::as_str).collect();
            let (values, stamps) = decode_topic(&log, &format!("/{arm}/joint_states"), &fields);
            check_same(
                &values,
                &truth[&format!("{stream}_{quantity}")].f64(),
                &format!("{stream} {quantity}"),
            );
            assert_eq!(stamps, truth[&format!("{stream}_stamp")].i64());
        }
    }
    let check = |topic: &str, fields: &[&str], column: &str, stamp: Option<&str>| {
        let (values, stamps) = decode_topic(&log, topic, fields);
        check_same(&values, &truth[column].f64(), topic);
        if let Some(stamp) = stamp {
            assert_eq!(stamps, truth[stamp].i64(), "{topic}");
        }
    };
    check("/cell/velocity_command", &["data[0:12]"], "command", None);
    check("/left/delta_pose_command", &["twist"], "delta", Some("delta_stamp"));
    check("/left/ee_pose", &["pose"], "ee_pose", Some("ee_pose_stamp"));
    check("/left/ee_rotvec", &["vector"], "ee_rotvec", Some("ee_rotvec_stamp"));
    let frames = ["left_shoulder", "left_tool0", "right_shoulder", "right_tool0"];
    let fields: Vec<String> =
        frames.iter().map(|f| format!("transforms[child_frame_id=\"{f}\"].transform")).collect();
    check("/tf", &fields.iter().map(String::as_str).collect::<Vec<_>>(), "tf", Some("tf_stamp"));
    assert_eq!(truth["tf"].bytes.len(), 600 * 4 * 7 * 8);
}

/// Takes the images of one topic out of a log.
fn images(log: &[Sample], topic: &str, mut each: impl FnMut(usize, ImageMessage<'_>)) {
    let library = SchemaLibrary::builtin();
    let mut sink = RowSink::new();
    let samples = log.iter().filter(|s| s.channel.topic == topic);
    for (i, sample) in samples.enumerate() {
        let plan = ImagePlan::compile(&schema_of(&sample.channel), &library).unwrap();
        each(i, plan.extract(&sample.data, &mut sink).unwrap());
    }
}

fn pixels_of(image: &ImageMessage<'_>) -> gawm_image::Image {
    let raw = gawm_image::RawImage {
        layout: &image.format,
        width: image.width,
        height: image.height,
        step: image.step,
        is_big_endian: image.is_big_endian,
        data: &image.data,
    };
    gawm_image::decode_raw(&raw, &gawm_image::Limits::default()).unwrap()
}

/// The swatches of the test picture stand somewhere in every frame; RGB must come back within `tolerance`.
fn check_swatches(image: gawm_image::Image, swatches: &[[u8; 3]], tolerance: u8, name: &str) {
    let gawm_image::Pixels::Rgb8(values) = gawm_image::to_rgb8(image).unwrap().into_pixels() else {
        panic!("colour")
    };
    for swatch in swatches {
        let near = |p: &[u8; 3]| p.iter().zip(swatch).all(|(a, b)| a.abs_diff(*b) <= tolerance);
        let n = values.as_chunks::<3>().0.iter().filter(|p| near(p)).count();
        assert!(n >= 30, "{name}: swatch {swatch:?} has {n} pixels");
    }
}

#[test]
fn cell_images_equal_their_truth() {
    let Some(shared) = shared() else { return };
    let folder = shared.join("corpora/cell");
    let truth = Truth::load(&folder.join("truth/cell.npz"));
    let info: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.join("truth/cell.json")).unwrap()).unwrap();
    let swatches: Vec<[u8; 3]> = serde_json::from_value(info["constants"]["swatches_rgb"].clone())
        .or_else(|_| serde_json::from_value(info["swatches_rgb"].clone()))
        .unwrap();
    let log = messages(&folder.join("cell_mixed_zstd.mcap"));
    let crc = |column: &str, i: usize| truth[column].i64()[i];
    let mut layouts = std::collections::BTreeSet::new();
    images(&log, "/cam/side/image_raw", |i, image| {
        assert_eq!(i64::from(crc32fast::hash(&image.data)), crc("side_crc32", i));
        assert_eq!(i64::from(image.step), crc("side_step", i));
        if layouts.insert(image.format.to_string()) && image.format != "mono8" {
            check_swatches(pixels_of(&image), &swatches, 4, &image.format);
        } else {
            pixels_of(&image);
        }
    });
    assert_eq!(layouts.len(), 6);
    let limits = gawm_image::Limits::default();
    for (topic, column) in [("/cam/wrist/image/compressed", "wrist"), ("/cam/overhead/image", "overhead")] {
        images(&log, topic, |i, image| {
            assert_eq!(
                i64::from(crc32fast::hash(&image.data)),
                crc(&format!("{column}_crc32"), i),
                "{topic}"
            );
            gawm_image::verify(&image.data).unwrap();
            if i % 50 == 0 {
                check_swatches(gawm_image::decode(&image.data, &limits).unwrap(), &swatches, 12, topic);
            }
        });
    }
    let depth_crc = |image: gawm_image::Image| {
        let bytes: Vec<u8> = match image.into_pixels() {
            gawm_image::Pixels::Gray16(values) => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
            gawm_image::Pixels::GrayF32(values) => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
            other => panic!("{}", other.name()),
        };
        i64::from(crc32fast::hash(&bytes))
    };
    images(&log, "/cam/side/depth/image_raw", |i, image| {
        let decoded = pixels_of(&image);
        let file = gawm_image::encode_png(&decoded).unwrap();
        assert_eq!(depth_crc(gawm_image::decode(&file, &limits).unwrap()), crc("depth16_pixels_crc32", i));
    });
    images(&log, "/cam/wrist/depth/image", |i, image| {
        let file = gawm_image::encode_tiff(&pixels_of(&image)).unwrap();
        assert_eq!(depth_crc(gawm_image::decode(&file, &limits).unwrap()), crc("depthf_pixels_crc32", i));
    });
    images(&log, "/cam/overhead/depth/compressedDepth", |i, image| {
        let depth = gawm_image::decode_compressed_depth(&image.format, &image.data, &limits).unwrap();
        assert_eq!(depth_crc(depth), crc("depthc_pixels_crc32", i));
    });
}

#[test]
fn cell_calibrations_equal_their_truth() {
    let Some(shared) = shared() else { return };
    let folder = shared.join("corpora/cell");
    let info: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.join("truth/cell.json")).unwrap()).unwrap();
    let log = messages(&folder.join("cell_mixed_zstd.mcap"));
    for camera in ["wrist", "overhead", "side"] {
        let topic = format!("/cam/{camera}/camera_info");
        let sample = log.iter().find(|s| s.channel.topic == topic).unwrap();
        let got =
            CameraInfo::decode(&schema_of(&sample.channel), &sample.data, &SchemaLibrary::builtin()).unwrap();
        let expected = &info["calibration"][camera];
        let numbers = |key: &str| -> Vec<f64> { serde_json::from_value(expected[key].clone()).unwrap() };
        assert_eq!((got.k.to_vec(), got.d, got.r.to_vec()), (numbers("k"), numbers("d"), numbers("r")));
        assert_eq!(got.p.to_vec(), numbers("p"));
        assert_eq!(u64::from(got.width), expected["width"].as_u64().unwrap());
    }
}

#[test]
fn corrupt_jpegs_are_refused_and_the_others_decode() {
    let Some(shared) = shared() else { return };
    let log = messages(&shared.join("corpora/generated/bad_corrupt_jpegs.mcap"));
    let limits = gawm_image::Limits::default();
    let mut bad = Vec::new();
    images(&log, "/camera/image/compressed", |i, image| {
        let decoded = gawm_image::decode(&image.data, &limits);
        assert_eq!(decoded.is_err(), gawm_image::verify(&image.data).is_err(), "image {i}");
        if decoded.is_err() {
            bad.push(i);
        }
    });
    assert_eq!(bad, [15, 60, 105, 150]);
}
