//! Small videos made here, compared with what FFmpeg's own program says of them.

use std::fs;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};
use sha2::{Digest, Sha256};

use super::file::VideoFile;
use super::testing::{fixture, number_of, packets};
use super::*;

/// The hash of each frame's planes, by `ffmpeg -f framehash`.
fn hashes(name: &str) -> Vec<String> {
    let text = fs::read_to_string(fixture(&format!("{name}.sha256"))).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines.map(|line| line.rsplit(',').next().unwrap().trim().to_owned()).collect()
}

fn hash_at(file: &mut VideoFile, secs: f64) -> String {
    let planes = file.raw_at(secs).unwrap().plane_bytes();
    Sha256::digest(planes).iter().map(|byte| format!("{byte:02x}")).collect()
}

const VIDEOS: [&str; 4] = ["h264.mp4", "hevc.mp4", "av1.mp4", "bt709.mp4"];

#[test]
fn every_frame_is_that_of_ffmpeg_to_the_bit() {
    for name in VIDEOS {
        let expected = hashes(name);
        assert_eq!(expected.len(), 30);
        let mut file = VideoFile::open(&fixture(name)).unwrap();
        for (number, expected) in expected.iter().enumerate() {
            assert_eq!(hash_at(&mut file, number as f64 / 10.0), *expected, "{name} frame {number}");
        }
    }
}

#[test]
fn frames_are_found_in_any_order() {
    for name in VIDEOS {
        let expected = hashes(name);
        let mut file = VideoFile::open(&fixture(name)).unwrap();
        for number in [17, 3, 29, 0, 12, 11, 13, 28, 28, 24, 1] {
            assert_eq!(hash_at(&mut file, number as f64 / 10.0), expected[number], "{name} frame {number}");
        }
        let frame = file.frame_at(2.1).unwrap();
        assert_eq!((frame.width, frame.height, number_of(64, &frame.data)), (64, 48, 21), "{name}");
    }
}

#[test]
fn colours_are_those_of_ffmpeg_but_for_rounding() {
    let bytes = fs::read(fixture("h264_frame7.png")).unwrap();
    let expected = gawm_image::decode(&bytes, &gawm_image::Limits::default()).unwrap();
    let gawm_image::Pixels::Rgb8(expected) = expected.pixels() else { panic!("no RGB") };
    let frame = VideoFile::open(&fixture("h264.mp4")).unwrap().frame_at(0.7).unwrap();
    let differences: Vec<u8> = frame.data.iter().zip(expected).map(|(a, b)| a.abs_diff(*b)).collect();
    // FFmpeg's fast conversion works with tables of fewer bits.
    let (largest, sum) =
        (differences.iter().max().unwrap(), differences.iter().map(|d| u64::from(*d)).sum::<u64>());
    let mean = sum as f64 / differences.len() as f64;
    assert!(*largest <= 3 && mean < 1.5, "largest {largest}, mean {mean}");
}

#[track_caller]
fn check_no_frame(file: &mut VideoFile, secs: f64, part: &str) {
    let error = file.frame_at(secs).unwrap_err();
    assert!(matches!(error, VideoError::NoFrame { .. }), "{error}");
    assert!(error.to_string().contains(part), "{error}");
}

#[test]
fn only_a_frame_at_the_time_is_taken() {
    let mut file = VideoFile::open(&fixture("h264.mp4")).unwrap();
    assert_eq!(number_of(64, &file.frame_at(0.200_05).unwrap().data), 2);
    check_no_frame(&mut file, 0.25, "one at 0.");
    check_no_frame(&mut file, 0.3002, "one at 0.3000 s");
    assert_eq!(number_of(64, &file.frame_at(0.4).unwrap().data), 4);
    check_no_frame(&mut file, 3.0, "one at 2.9000 s");
    check_no_frame(&mut file, 1e6, "one at");
    assert_eq!(number_of(64, &file.frame_at(0.0).unwrap().data), 0);
}

#[test]
fn what_is_no_mp4_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let playlist = format!("ffconcat version 1.0\nfile '{}'\n", fixture("h264.mp4").display());
    for bytes in [b"".as_slice(), b"garbage", &[0; 5000], playlist.as_bytes(), b"#EXTM3U\n"] {
        let path = dir.path().join("x.mp4");
        fs::write(&path, bytes).unwrap();
        assert!(matches!(VideoFile::open(&path), Err(VideoError::Open { .. })), "{bytes:?}");
    }
    assert!(matches!(VideoFile::open(&dir.path().join("absent.mp4")), Err(VideoError::Open { .. })));
    assert!(matches!(VideoFile::open(dir.path()), Err(VideoError::Open { .. })));
}

#[test]
fn what_refers_to_a_damaged_frame_is_lost_up_to_the_next_keyframe() {
    const FRAMES_OF_A_GROUP: usize = 12;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.mp4");
    let mut n_lost = 0;
    // The HEVC decoder passes over some damaged units without a word.
    for name in ["h264.mp4", "bt709.mp4"] {
        let (whole, expected) = (fs::read(fixture(name)).unwrap(), hashes(name));
        let data = whole.windows(4).position(|four| four == b"mdat").unwrap() + 4;
        for at in (data + 900..data + 1900).step_by(50) {
            let mut bytes = whole.clone();
            bytes[at..at + 30].fill(0x5a);
            fs::write(&path, &bytes).unwrap();
            let mut file = VideoFile::open(&path).unwrap();
            let mut is_lost = false;
            for (number, expected) in expected.iter().enumerate() {
                is_lost &= number % FRAMES_OF_A_GROUP != 0;
                match file.raw_at(number as f64 / 10.0) {
                    Err(_) => {
                        n_lost += 1;
                        is_lost = true;
                    }
                    // Damage that is a valid picture is not seen by any decoder; what is seen is not painted over.
                    Ok(frame) => {
                        let hash = Sha256::digest(frame.plane_bytes());
                        let hash: String = hash.iter().map(|byte| format!("{byte:02x}")).collect();
                        assert!(!is_lost || hash == *expected, "{name}, byte {at}: frame {number}");
                    }
                }
            }
        }
    }
    assert!(n_lost > 100, "{n_lost}");
}

#[test]
fn a_file_that_is_cut_off_gives_the_frames_that_it_has() {
    let dir = tempfile::tempdir().unwrap();
    let (bytes, expected) = (fs::read(fixture("bt709.mp4")).unwrap(), hashes("bt709.mp4"));
    for cut in (0..bytes.len()).step_by(97) {
        let path = dir.path().join("cut.mp4");
        fs::write(&path, &bytes[..cut]).unwrap();
        let Ok(mut file) = VideoFile::open(&path) else { continue };
        let mut n_lost = 0;
        for (number, expected) in expected.iter().enumerate() {
            match file.raw_at(number as f64 / 10.0).map(|frame| frame.plane_bytes()) {
                Ok(planes) => {
                    let got: String = Sha256::digest(planes).iter().map(|b| format!("{b:02x}")).collect();
                    assert_eq!(got, *expected, "cut at {cut}, frame {number}");
                    assert_eq!(n_lost, 0, "cut at {cut}: a frame after a lost one");
                }
                Err(_) => n_lost += 1,
            }
        }
        assert!(n_lost > 0, "cut at {cut}");
    }
}

#[test]
fn damaged_bytes_never_break_the_program() {
    let dir = tempfile::tempdir().unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for round in 0..48 {
        let mut bytes = fs::read(fixture(VIDEOS[round % 4])).unwrap();
        for _ in 0..1 + round % 7 {
            let at = random.next_u64() as usize % bytes.len();
            bytes[at] = random.next_u32() as u8;
        }
        let path = dir.path().join("damaged.mp4");
        fs::write(&path, &bytes).unwrap();
        if let Ok(mut file) = VideoFile::open(&path) {
            for number in [0, 1, 2, 15, 29, 3] {
                file.frame_at(f64::from(number) / 10.0).ok(); // Right or an error; never a panic.
            }
        }
    }
}

#[test]
fn threads_share_a_file() {
    let (lanes, path) = (VideoLanes::default(), fixture("h264.mp4"));
    std::thread::scope(|scope| {
        for thread in 0..3 {
            let (lanes, path) = (&lanes, &path);
            scope.spawn(move || {
                for block in (thread..6).step_by(3) {
                    let wanted: Vec<f64> = (0..5).map(|i| f64::from(block * 5 + i) / 10.0).collect();
                    let mut numbers = Vec::new();
                    lanes.read(path, &wanted, |at, frame| {
                        numbers.push((at, number_of(64, &frame.unwrap().data)));
                    });
                    let expected: Vec<_> = (0..5).map(|i| (i, block as usize * 5 + i)).collect();
                    assert_eq!(numbers, expected);
                }
            });
        }
    });
    let mut errors = 0;
    lanes.read(&fixture("absent.mp4"), &[0.0, 0.1], |_, frame| errors += usize::from(frame.is_err()));
    assert_eq!(errors, 2);
}

/// Feeds packets and returns the numbers of those whose frame came, by number drawn, and the others' errors.
fn feed(packets: &[(usize, Vec<u8>)]) -> (Vec<usize>, Vec<(usize, VideoError)>) {
    let mut decoder = PacketDecoder::new("h264").unwrap();
    let (mut numbers, mut errors) = (Vec::new(), Vec::new());
    let mut take = |frames: Vec<(i64, RgbFrame)>| {
        for (number, frame) in frames {
            assert_eq!(number_of(64, &frame.data), number as usize, "the frame of another packet");
            numbers.push(number as usize);
        }
    };
    for (number, packet) in packets {
        match decoder.push(*number as i64, packet) {
            Ok(frames) => take(frames),
            Err(error) => errors.push((*number, error)),
        }
    }
    take(decoder.finish());
    (numbers, errors)
}

#[test]
fn packets_of_a_topic_give_their_frames() {
    let all: Vec<(usize, Vec<u8>)> = packets().unwrap().into_iter().enumerate().collect();
    assert_eq!(feed(&all), ((0..30).collect(), Vec::new()));
    // A log that begins between two keyframes.
    let (numbers, errors) = feed(&all[13..]);
    assert_eq!(numbers, (20..30).collect::<Vec<_>>());
    let before: Vec<_> = (13..20).map(|number| (number, VideoError::BeforeKeyframe)).collect();
    assert_eq!(errors, before);
}

#[test]
fn a_lost_packet_costs_those_up_to_the_next_keyframe() {
    let mut some: Vec<(usize, Vec<u8>)> = packets().unwrap().into_iter().enumerate().collect();
    some.remove(14);
    let (numbers, errors) = feed(&some);
    assert_eq!(numbers, (0..14).chain(20..30).collect::<Vec<_>>());
    assert_eq!(errors.iter().map(|(number, _)| *number).collect::<Vec<_>>(), (15..20).collect::<Vec<_>>());
}

#[test]
fn packets_that_are_none_are_errors() {
    for bad in [b"".as_slice(), b"not a packet", &[0, 0, 0, 1], &[0, 0, 1, 0x65, 1, 2, 3]] {
        let mut decoder = PacketDecoder::new("h264").unwrap();
        assert!(decoder.push(0, bad).is_err() || decoder.finish().is_empty(), "{bad:?}");
        // The decoder goes on with the next keyframe.
        assert_eq!(decoder.push(1, &packets().unwrap()[0]).unwrap().len(), 1, "{bad:?}");
    }
    assert!(matches!(PacketDecoder::new("mjpeg"), Err(VideoError::Codec { .. })));
    assert!(matches!(PacketDecoder::new(""), Err(VideoError::Codec { .. })));
    let huge = fs::read(fixture("huge.h264")).unwrap();
    let mut decoder = PacketDecoder::new("H264").unwrap();
    let outcome = decoder.push(0, &huge);
    assert!(!matches!(&outcome, Ok(frames) if !frames.is_empty()), "128 million pixels came out");
    assert!(decoder.finish().is_empty());
}
