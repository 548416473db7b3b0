//! Damaged and hostile files: an error or the right values, never a panic or much memory.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

use super::*;

/// Small caps, so that a damaged length shows as an error and not as memory.
fn small_limits() -> Limits {
    let mib = 1 << 20;
    Limits {
        max_read_bytes: mib,
        max_chunk_bytes: 4 * mib,
        max_array_bytes: 4 * mib,
        cache_bytes: mib,
        max_chunks: 4096,
        ..Limits::default()
    }
}

/// Opens a file and touches everything in it; returns how many columns could be read.
fn read_everything(path: &Path) -> usize {
    let Ok(table) = open(path, &small_limits()) else { return 0 };
    let mut n = 0;
    for column in table.columns() {
        n += usize::from(table.read_rows(&column.path, 0..column.readable_rows.min(64)).is_ok());
        let last = column.readable_rows.saturating_sub(1);
        n += usize::from(table.read_rows(&column.path, last..column.readable_rows).is_ok());
    }
    if let Ok(found) = table.episodes(None) {
        n += found.episodes.len();
    }
    n
}

/// Damages copies of a fixture at random places of a fixed seed.
fn check_mutations(name: &str, seed: u64, count: usize) {
    let bytes = std::fs::read(fixture(name)).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, &bytes).unwrap();
    let whole = read_everything(&path);
    assert!(whole > 0);
    let mut n_damaged = 0;
    for _ in 0..count {
        let mut copy = bytes.clone();
        if rng.next_u32() % 4 == 0 {
            copy.truncate(rng.next_u32() as usize % bytes.len());
        }
        for _ in 0..1 + rng.next_u32() % 8 {
            if !copy.is_empty() {
                let at = rng.next_u32() as usize % copy.len();
                copy[at] = match rng.next_u32() % 3 {
                    0 => 0xff,
                    1 => copy[at] ^ (1 << (rng.next_u32() % 8)),
                    _ => rng.next_u32() as u8,
                };
            }
        }
        std::fs::write(&path, &copy).unwrap();
        n_damaged += usize::from(read_everything(&path) < whole);
    }
    assert!(n_damaged > 0, "{name}: no damage was noticed in {count} files");
}

#[test]
fn damaged_files_never_panic() {
    check_mutations("layouts_v0.h5", 1, 120);
    check_mutations("layouts_v3.h5", 2, 120);
    check_mutations("codecs.h5", 3, 60);
    check_mutations("foreign.h5", 4, 120);
    check_mutations("killed.h5", 5, 200);
    check_mutations("arrays.npz", 6, 300);
    check_mutations("stored.npz", 7, 150);
}

#[test]
fn one_broken_header_does_not_hide_the_group() {
    for (name, signature) in [("layouts_v3.h5", true), ("layouts_v0.h5", false)] {
        let table = open_fixture(name);
        let n_columns = table.columns().len();
        drop(table);
        let bytes = std::fs::read(fixture(name)).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(name);
        let mut n_partial = 0;
        // Every object header of the new format starts with OHDR; of the old one with version 1 and a count.
        let starts: Vec<usize> = (48..bytes.len() - 16)
            .filter(|&i| {
                if signature {
                    bytes[i..].starts_with(b"OHDR")
                } else {
                    i % 8 == 0 && bytes[i..i + 2] == [1, 0] && bytes[i + 4..i + 8] == [1, 0, 0, 0]
                }
            })
            .collect();
        assert!(starts.len() > 5, "{name}: {}", starts.len());
        for at in starts {
            let mut copy = bytes.clone();
            copy[at] ^= 0x7e;
            std::fs::write(&path, &copy).unwrap();
            let Ok(table) = open(&path, &Limits::default()) else { continue };
            let is_noted = table.findings().iter().any(|f| f.kind == FindingKind::BrokenObject);
            assert!(is_noted || table.columns().len() == n_columns, "{name} at {at:#x}");
            n_partial += usize::from(is_noted && table.columns().len() + 3 >= n_columns);
        }
        assert!(n_partial > 5, "{name}: {n_partial} files with one broken header kept the rest");
    }
}

#[test]
fn blosc_headers_that_lie_are_errors() {
    let bytes = std::fs::read(fixture("codecs.h5")).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("codecs.h5");
    // The frame of the first chunk of lz4/shuffle_1/f4 is found by its header: version 2, codec 1, f4, 3072 bytes.
    let header = [2, 1, 0x31, 4, 0, 12, 0, 0, 0, 12, 0, 0];
    let at = bytes
        .windows(12)
        .position(|w| w[0] == header[0] && w[1] == 1 && w[3] == 4 && w[4..] == header[4..])
        .unwrap();
    let cases: [(usize, &[u8]); 7] = [
        (0, &[9]),
        (4, &[255, 255, 255, 255]),
        (4, &[1, 12, 0, 0]),
        (8, &[0, 0, 0, 0]),
        (8, &[255, 255, 255, 127]),
        (12, &[255, 255, 255, 127]),
        (16, &[255, 255, 255, 127]),
    ];
    for (offset, lie) in cases {
        let mut copy = bytes.clone();
        copy[at + offset..][..lie.len()].copy_from_slice(lie);
        std::fs::write(&path, &copy).unwrap();
        let table = open(&path, &Limits::default()).unwrap();
        let n_damaged = table
            .columns()
            .iter()
            .filter(|c| matches!(table.read_all(&c.path), Err(ReadError::Damaged { .. })))
            .count();
        assert_eq!(n_damaged, 1, "offset {offset}: {lie:?}");
    }
}

fn check_refused(name: &str, bytes: &[u8], expected: &str) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    let refused = open(&path, &Limits::default()).err().unwrap_or_else(|| panic!("{name} opened"));
    assert!(refused.to_string().contains(expected), "{name}: {refused}");
}

#[test]
fn files_of_other_formats_are_refused_by_name() {
    check_refused("empty", b"", "file is empty");
    check_refused("a.npy", b"\x93NUMPY\x01\0v\0{", "one npy array");
    check_refused("a.mcap", b"\x89MCAP0\r\n", "an MCAP log");
    check_refused("a.db3", b"SQLite format 3\0....", "an SQLite database");
    check_refused("a.h5", b"version https://git-lfs.github.com/spec/v1\n", "a git LFS pointer");
    check_refused("a.bin", &[7; 3000], "bytes [07, 07");
    check_refused("cut.h5", b"\x89HDF\r\n\x1a\n", "damaged HDF5 file");
    check_refused("cut.npz", b"PK\x03\x04....", "damaged npz file");
    assert!(matches!(open(Path::new("/nowhere/x.h5"), &Limits::default()), Err(OpenTableError::Io { .. })));
}

/// Extents that were never written cost nothing to claim, and must cost nothing to meet.
#[test]
fn claims_of_great_size_are_refused() {
    let table = open_fixture("claims.h5");
    let of = |path: &str| table.read_rows(path, 0..table.column(path).unwrap().readable_rows);
    assert!(matches!(of("huge"), Err(ReadError::TooLarge { what: "extent", .. })));
    assert!(matches!(of("long_text"), Err(ReadError::TooLarge { what: "element", .. })));
    assert!(matches!(of("texts"), Err(ReadError::TooLarge { what: "read", .. })));
    assert!(matches!(of("many_chunks"), Err(ReadError::Damaged { .. })));
    assert_eq!(of("no_width").unwrap().values.len(), 0);
    assert!(table.content_hash("no_width").is_ok());
    assert_eq!(table.read_rows("x0", 4_194_303..4_194_304).unwrap().values, Values::F32(vec![1.0]));
    assert!(matches!(table.episodes(None), Err(LayoutError::TooMany { .. })));
    let marked = Layout::Terminals { terminals: "terminals".to_owned(), timeouts: None };
    assert!(matches!(table.episodes(Some(&marked)), Err(LayoutError::TooMany { .. })));
}

/// A zip that says 4 GB in 4 MB is refused before it is inflated, and one that lies about it soon after.
#[test]
fn bombs_are_refused() {
    use std::io::Write;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("bomb.npz");
    let write = |shape: &str, payload: usize| {
        let mut zip = zip::ZipWriter::new(File::create(&path).unwrap());
        let options =
            zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        zip.start_file("x.npy", options).unwrap();
        let header = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}\n");
        zip.write_all(b"\x93NUMPY\x01\0").unwrap();
        zip.write_all(&(header.len() as u16).to_le_bytes()).unwrap();
        zip.write_all(header.as_bytes()).unwrap();
        zip.write_all(&vec![0; payload]).unwrap();
        zip.finish().unwrap();
    };
    let read = || open(&path, &small_limits()).unwrap().read_rows("x", 0..1);
    write("(5000000,)", 5_000_000);
    assert!(matches!(
        read(),
        Err(ReadError::TooLarge { what: "array", limit: 4_194_304, got: 5_000_000, .. })
    ));
    write("(9223372036854775807, 4)", 10);
    assert!(matches!(read(), Err(ReadError::TooLarge { .. })));
    write("(10,)", 5_000_000);
    assert!(matches!(read(), Err(ReadError::Damaged { .. })));
    write("(0, 9223372036854775807)", 0);
    assert!(matches!(read(), Err(ReadError::RowsOutOfRange { rows: 0, .. })));
    write("(10,)", 10);
    assert!(read().is_ok());
}
