//! Episodes as streams.

use super::super::samples::{SampleError, SampleReader, Selection, StreamBatch, StreamRequest};
use super::*;

fn vector(column: &str, fields: &[&str]) -> StreamRequest {
    let fields = fields.iter().map(|f| Selection::parse(f).unwrap()).collect();
    StreamRequest { column: column.to_owned(), fields, is_image: false }
}

fn image(column: &str) -> StreamRequest {
    StreamRequest { column: column.to_owned(), fields: Vec::new(), is_image: true }
}

/// A whole stream: values and presence, or the number of frames.
type Whole = (Vec<f64>, Vec<bool>, usize);

fn read_all(table: &Table, episode: &Episode, requests: &[StreamRequest]) -> (u64, Vec<Whole>) {
    let mut reader = SampleReader::try_new(table, episode, requests).unwrap();
    let mut all = vec![(Vec::new(), Vec::new(), 0); requests.len()];
    let mut next = 0;
    while let Some(batch) = reader.next_batch().unwrap() {
        assert_eq!(batch.rows.start, next);
        next = batch.rows.end;
        for (all, stream) in all.iter_mut().zip(batch.streams) {
            match stream {
                StreamBatch::Vector { width, values, present } => {
                    assert_eq!(values.len(), present.len() * width);
                    all.0.extend(values);
                    all.1.extend(present);
                }
                StreamBatch::Image { frames, .. } => all.2 += frames.len(),
            }
        }
    }
    (next, all)
}

#[test]
fn the_action_that_is_nan_is_no_sample() {
    let table = open_fixture("killed.h5");
    let found = table.episodes(None).unwrap();
    let requests = [vector("action", &[]), vector("proprio", &["[1]", "[0:2]"]), image("pixels")];
    let (rows, streams) = read_all(&table, &found.episodes[1], &requests);
    assert_eq!(rows, 9);
    assert_eq!(streams[0].1, [true, true, true, true, true, true, true, true, false]);
    assert_eq!(streams[0].0[..4], [12.0, -12.0, 13.0, -13.0]);
    assert_eq!(streams[1].0[..6], [0.0, 6.0, 0.0, 1.0, 6.5, 1.0]);
    assert_eq!(streams[2].2, 9);
}

#[test]
fn the_final_observation_is_a_row_without_action() {
    let Some(path) = corpus("mj_lift_npz/episode_000/trajectory.npz") else { return };
    let table = open(&path, &Limits::default()).unwrap();
    let found = table.episodes(None).unwrap();
    let requests = [vector("obs_state", &["[0:3]"]), vector("actions", &[]), image("obs_rgb")];
    let (rows, streams) = read_all(&table, &found.episodes[0], &requests);
    assert_eq!((rows, streams[0].0.len(), streams[2].2), (80, 240, 80));
    assert!(streams[0].1.iter().all(|&p| p));
    assert_eq!(streams[1].1.iter().filter(|&&p| p).count(), 79);
    assert!(!streams[1].1[79] && streams[1].0[79 * 4].is_nan());
}

#[test]
fn streams_that_an_episode_does_not_have_are_errors() {
    let table = open_fixture("stored.npz");
    let found = table.episodes(None).unwrap();
    let refused = |request| SampleReader::try_new(&table, &found.episodes[0], &[request]).err().unwrap();
    assert!(
        matches!(refused(vector("action", &[])), SampleError::UnknownColumn { known, .. } if known == "actions, observations")
    );
    assert!(matches!(refused(vector("fps", &[])), SampleError::NotPerStep { rows: 1, steps: 300, .. }));
    assert!(matches!(
        refused(vector("actions", &["[1:3]"])),
        SampleError::FieldOutOfRange { start: 1, end: 3, width: 2, .. }
    ));
    assert!(matches!(refused(image("actions")), SampleError::Read(ReadError::WrongKind { .. })));
}
