//! Every storage, filter and type, against values computed again.

use super::*;

fn check_rows(table: &Table, path: &str, rows: std::ops::Range<usize>) {
    let got =
        table.read_rows(path, rows.start as u64..rows.end as u64).unwrap_or_else(|e| panic!("{path}: {e}"));
    assert_eq!(got.values.to_f64().unwrap(), expected(rows.clone()), "{path} {rows:?}");
    assert_eq!((got.rows, got.row_shape), (rows.len(), vec![3]), "{path}");
}

#[test]
fn blosc_codecs_shuffles_and_types() {
    let table = open_fixture("codecs.h5");
    let mut n = 0;
    for codec in ["blosclz", "lz4", "lz4hc", "zlib", "zstd"] {
        for shuffle in 0..3 {
            for dtype in ["u1", "i2", "f4", "f8"] {
                let path = format!("{codec}/shuffle_{shuffle}/{dtype}");
                // u1 holds values below 256 in these rows.
                check_rows(&table, &path, 0..400);
                check_rows(&table, &path, 250..260);
                check_rows(&table, &path, 399..400);
                n += 1;
            }
        }
    }
    assert_eq!(n, 60);
    assert_eq!(table.findings(), []);
}

#[test]
fn blosc_rows_touch_few_blocks_and_absent_chunks_hold_the_fill_value() {
    let table = open_fixture("codecs.h5");
    for row in [0u64, 21_845, 21_846, 65_535, 119_999] {
        let got = table.read_rows("many_blocks", row..row + 1).unwrap().values.to_f64().unwrap();
        let expected: Vec<f64> = (0..3).map(|c| ((row * 3 + c) / 6000) as f64).collect();
        assert_eq!(got, expected, "row {row}");
    }
    let got = table.read_all("empty_chunks").unwrap().values.to_f64().unwrap();
    assert!(got[..48].iter().chain(&got[96..]).all(|&v| v == 2.5));
    assert_eq!(got[48..96], expected(0..16)[..]);
    // Noise does not compress: the writer skipped the filter (filter mask).
    let whole = table.read_all("noise").unwrap();
    let Values::U8(whole) = whole.values else { panic!("expected u8") };
    let mut image = Vec::new();
    for row in 0..24 {
        assert_eq!(table.read_image("noise", row, &mut image).unwrap(), [8, 8, 3]);
        assert_eq!(image, whole[row as usize * 192..][..192], "row {row}");
    }
    assert!(whole.iter().any(|&b| b != whole[0]));
}

#[test]
fn every_storage_of_both_file_formats() {
    let columns = [
        "contiguous",
        "big_endian",
        "half",
        "chunked",
        "gzip_shuffle",
        "fletcher32",
        "lz4",
        "growing",
        "growing_2d",
        "single_chunk",
    ];
    for file in ["layouts_v0.h5", "layouts_v3.h5"] {
        let table = open_fixture(file);
        assert_eq!(table.findings(), [], "{file}");
        for column in columns {
            check_rows(&table, column, 0..300);
            check_rows(&table, column, 63..65);
            check_rows(&table, column, 299..300);
            check_rows(&table, column, 7..7);
        }
        check_rows(&table, "masked", 0..128);
        check_rows(&table, "deep/group/array", 0..2);
        check_values(&table, "bools", &Values::Bool((0..300).map(|r| (r % 16) * 7 + r / 50 > 50).collect()));
        check_values(&table, "text", &Values::Text((0..5).map(|i| format!("row {i}")).collect()));
        check_values(&table, "fixed_text", &Values::Text(vec!["ab".to_owned(), "c".to_owned()]));
        check_values(&table, "scalar", &Values::I64(vec![-7]));
        check_values(&table, "null", &Values::F32(Vec::new()));
        check_values(&table, "zero_rows", &Values::F32(Vec::new()));
        check_values(&table, "unallocated", &Values::F32(vec![1.5; 900]));
        let never = table.read_all("never_written").unwrap().values.to_f64().unwrap();
        assert!(never.len() == 900 && never.iter().all(|v| v.is_nan()));
        assert_eq!(table.column("/scalar").unwrap().rows(), None);
        check_attributes(&table);
    }
}

fn check_values(table: &Table, path: &str, expected: &Values) {
    assert_eq!(&table.read_all(path).unwrap().values, expected, "{path}");
}

fn check_attributes(table: &Table) {
    let deep = &table.groups()["deep"];
    let of = |name: &str| &deep.iter().find(|a| a.name == name).unwrap().value;
    assert_eq!(of("task"), &AttributeValue::Text("pick".to_owned()));
    assert_eq!(of("n"), &AttributeValue::Integer(3));
    assert_eq!(of("gains"), &AttributeValue::Numbers(vec![0.5, 1.5]));
    let unit = &table.column("contiguous").unwrap().attributes;
    assert_eq!(unit[0].value, AttributeValue::Text("m".to_owned()));
}

#[test]
fn equal_arrays_have_equal_hashes_whatever_stores_them() {
    let (old, new) = (open_fixture("layouts_v0.h5"), open_fixture("layouts_v3.h5"));
    let hash = old.content_hash("contiguous").unwrap();
    for table in [&old, &new] {
        for column in ["big_endian", "chunked", "gzip_shuffle", "growing_2d", "single_chunk"] {
            assert_eq!(table.content_hash(column).unwrap(), hash, "{column}");
        }
        assert_ne!(table.content_hash("half").unwrap(), hash);
        assert_ne!(table.content_hash("never_written").unwrap(), hash);
    }
    assert_eq!(old.content_hash("text").unwrap(), new.content_hash("text").unwrap());
    let npz = open_fixture("arrays.npz");
    assert_eq!(npz.content_hash("little").unwrap(), hash);
}

#[test]
fn what_is_foreign_is_refused_by_name() {
    let table = open_fixture("foreign.h5");
    check_rows(&table, "fine", 0..300);
    check_rows(&table, "link", 0..300);
    let filter = |path: &str| match table.read_all(path) {
        Err(e @ ReadError::UnsupportedFilter { id, .. }) => {
            assert!(e.hint().unwrap().contains("gzip") || e.hint().unwrap().contains("h5repack"), "{e}");
            id
        }
        other => panic!("{path}: {other:?}"),
    };
    assert_eq!(["lzf", "zstd", "bitshuffle", "blosc2"].map(filter), [32000, 32015, 32008, 32026]);
    assert_eq!(table.read_all("external"), Err(ReadError::External { column: "external".to_owned() }));
    assert_eq!(table.read_all("virtual"), Err(ReadError::Virtual { column: "virtual".to_owned() }));
    for path in ["compound", "complex"] {
        assert!(matches!(table.read_all(path), Err(ReadError::UnsupportedType { .. })), "{path}");
    }
    let mut found = kinds(table.findings());
    // Nobody can ask for what a link leads to in vain, so that it is no damage of the rest.
    assert!(found.contains(&(FindingKind::UnreadableColumn, "link_to_nothing")));
    found.retain(|(kind, _)| *kind != FindingKind::UnreadableColumn);
    found.sort_unstable();
    assert_eq!(
        found,
        [
            (FindingKind::GroupLinkedTwice, "loop/again"),
            (FindingKind::GroupLinkedTwice, "loop/self"),
            (FindingKind::ExternalLink, "link_out"),
        ]
    );
}

#[test]
fn a_killed_recording_is_offered_up_to_its_last_flush() {
    let table = open_fixture("killed.h5");
    assert!(table.is_unclean());
    assert!(table.findings().iter().any(|f| f.kind == FindingKind::UncleanClose));
    let found = table.episodes(None).unwrap();
    assert_eq!(
        found.episodes.iter().map(|e| (e.steps, e.end)).collect::<Vec<_>>(),
        [(12, EpisodeEnd::Listed), (9, EpisodeEnd::Listed)]
    );
    // The flush came at row 31; later rows may or may not have reached the file, and are never more than recorded.
    let [tail] = &found.unfinished[..] else {
        panic!("expected one unfinished episode, got {:?}", found.unfinished)
    };
    assert_eq!((tail.end, tail.columns["action"].start), (EpisodeEnd::Open, 21));
    assert!((10..=31).contains(&tail.steps), "{} steps", tail.steps);
    assert!(found.findings.iter().any(|f| f.kind == FindingKind::UnfinishedTail));
    let actions = table.read_rows("action", 0..31).unwrap().values.to_f64().unwrap();
    for row in 0..31usize {
        let is_last = row == 11 || row == 20;
        assert_eq!(actions[row * 2].is_nan(), is_last, "row {row}");
        assert!(is_last || actions[row * 2..row * 2 + 2] == [row as f64, -(row as f64)], "row {row}");
    }
    let mut image = Vec::new();
    for row in 0..31 {
        table.read_image("pixels", row, &mut image).unwrap();
        assert!(
            image.iter().enumerate().all(|(i, &b)| u64::from(b) == (row * 5 + i as u64) % 256),
            "row {row}"
        );
    }
}

#[test]
fn numpy_types_orders_and_byte_orders() {
    let table = open_fixture("arrays.npz");
    for path in ["little", "big", "half"] {
        check_rows(&table, path, 0..300);
        check_rows(&table, path, 299..300);
    }
    let fortran = table.read_rows("fortran", 4..6).unwrap();
    assert_eq!((fortran.values.to_f64().unwrap(), fortran.row_shape), (expected(40..60), vec![10, 3]));
    check_values(&table, "bools", &Values::Bool((0..300).map(|r| (r % 16) * 7 + r / 50 > 50).collect()));
    check_values(&table, "scalar", &Values::I64(vec![-7]));
    check_values(&table, "text", &Values::Text(vec!["ab".to_owned(), "ć".to_owned()]));
    check_values(&table, "bytes", &Values::Text(vec!["ab".to_owned(), "c".to_owned()]));
    check_values(&table, "empty", &Values::F64(Vec::new()));
    assert!(matches!(table.read_all("complex"), Err(ReadError::UnsupportedType { .. })));
    assert!(matches!(table.read_all("record"), Err(ReadError::UnsupportedType { .. })));
    assert_eq!(table.read_all("pickled"), Err(ReadError::Pickled { column: "pickled".to_owned() }));
}

#[test]
fn a_file_of_pickles_is_refused_and_never_opened() {
    let table = open_fixture("pickled_only.npz");
    let refused = table.episodes(None).unwrap_err();
    assert_eq!(
        refused,
        LayoutError::NothingReadable { first: ReadError::Pickled { column: "demos".to_owned() } }
    );
    assert!(refused.hint().unwrap().contains("never opened"));
}

#[test]
fn layouts_can_be_stated() {
    let table = open_fixture("stored.npz");
    let found = table.episodes(None).unwrap();
    assert_eq!((found.layout.name(), found.rows(), found.findings.len()), ("single", 300, 0));
    assert_eq!(found.episodes[0].columns["fps"].extent, Extent::Constant);
    let stated: Layout = toml::from_str("kind = \"single\"\nsteps = \"observations\"").unwrap();
    assert_eq!(table.episodes(Some(&stated)).unwrap().rows(), 300);
    let wrong = Layout::Groups { parent: "data".to_owned(), prefix: "demo_".to_owned() };
    assert!(matches!(table.episodes(Some(&wrong)), Err(LayoutError::DoesNotFit { layout: "groups", .. })));
    let wrong = Layout::Single { steps: Some("nothing".to_owned()) };
    assert!(matches!(table.episodes(Some(&wrong)), Err(LayoutError::DoesNotFit { layout: "single", .. })));
    let flat: Layout = toml::from_str("kind = \"flat\"").unwrap();
    assert!(matches!(table.episodes(Some(&flat)), Err(LayoutError::Read(ReadError::UnknownColumn { .. }))));
    assert!(toml::from_str::<Layout>("kind = \"flat\"\nlength = \"x\"").is_err());
}

#[test]
fn reads_out_of_range_and_of_unknown_columns_are_errors() {
    let table = open_fixture("layouts_v3.h5");
    #[expect(clippy::reversed_empty_ranges, reason = "a caller's mistake")]
    for rows in [0..301, 300..301, 5..4, u64::MAX - 1..u64::MAX] {
        let refused = table.read_rows("chunked", rows.clone());
        assert!(matches!(refused, Err(ReadError::RowsOutOfRange { rows: 300, .. })), "{rows:?}");
    }
    assert!(matches!(table.read_all("chunk"), Err(ReadError::UnknownColumn { .. })));
    assert!(matches!(table.read_image("chunked", 0, &mut Vec::new()), Err(ReadError::WrongKind { .. })));
}

#[test]
fn the_report_names_columns_as_a_contract_does() {
    let text = report(&open_fixture("killed.h5"), None).to_string();
    assert!(
        text.starts_with(
            "killed.h5: HDF5\n  2 episodes, 21 steps (9 to 12 each); layout \"flat\"\n  1 unfinished"
        ),
        "{text}"
    );
    assert!(text.contains("pixels    u8   [6, 6, 3]  per step; chunks of [10, 6, 6, 3], blosc"), "{text}");
    assert!(text.contains("the writer did not close the file"), "{text}");
    let refused = report(&open_fixture("pickled_only.npz"), None);
    assert!(refused.no_layout.unwrap().contains("hint: a pickle can run code"));
    let json = serde_json::to_value(report(&open_fixture("stored.npz"), None)).unwrap();
    assert_eq!(
        (&json["format"], &json["layout"]["kind"], &json["steps"]),
        (&"npz".into(), &"single".into(), &300.into())
    );
}
