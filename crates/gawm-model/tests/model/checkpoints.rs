//! Checkpoints: round trips, foreign layouts, and files that lie.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

use gawm_model::checkpoint::{
    self, About, CheckpointError, FormatError, ImportOptions, KeyLayout, TorchError,
};
use gawm_model::{AdamW, AdamWConfig, Device, Gradients, Objectives, Pass, Tensor, WorldModel, losses};
use safetensors::SafeTensors;

use crate::fixture::{bits, clips, model};

const MICRO: ImportOptions = ImportOptions { encoder_head_width: 8, predictor_head_width: 4 };

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Folder {
        Folder(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        std::fs::write(self.path(name), bytes).unwrap();
        self.path(name)
    }
}

fn trained() -> (WorldModel, AdamW) {
    let model = model(1, |_| {});
    let total = losses(&model, &clips(2, 3, 4), &Objectives::default(), &Pass::train(0, 0)).unwrap().total;
    let gradients = Gradients::of(&total, model.parameters()).unwrap();
    let mut optimizer = AdamW::new(AdamWConfig::default());
    optimizer.step(model.parameters(), &gradients, 1e-3).unwrap();
    (model, optimizer)
}

fn about() -> About {
    About {
        statistics: Some("{\"action\":{\"mean\":[0.5]}}".to_owned()),
        schema_hash: Some("5eed".to_owned()),
        notes: BTreeMap::from([("best".to_owned(), "0.25 at step 7".to_owned())]),
    }
}

fn load(path: &Path) -> Result<checkpoint::Checkpoint, CheckpointError> {
    checkpoint::load(path, &Device::Cpu)
}

#[test]
fn a_checkpoint_comes_back_whole() {
    let folder = Folder::new();
    let (model, optimizer) = trained();
    let path = folder.path("run.safetensors");
    checkpoint::save(&path, &model, &about(), Some(&optimizer)).unwrap();
    let loaded = load(&path).unwrap();
    assert_eq!(bits(&loaded.model), bits(&model));
    assert_eq!(loaded.model.architecture(), model.architecture());
    assert_eq!(loaded.about, about());
    let restored = loaded.optimizer.unwrap();
    assert_eq!((restored.step_count(), restored.config()), (1, optimizer.config()));
    for (name, moment) in optimizer.state() {
        let values = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values(&restored.state()[&name]), values(&moment), "{name}");
    }

    // The same state gives the same bytes, nothing else is left in the folder, and another reader understands it.
    let again = folder.path("again.safetensors");
    checkpoint::save(&again, &loaded.model, &about(), Some(&restored)).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(std::fs::read(&again).unwrap(), bytes);
    assert_eq!(folder.0.path().read_dir().unwrap().count(), 2);
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let shape =
        tensors.tensor("encoder.embeddings.patch_embeddings.projection.weight").unwrap().shape().to_vec();
    assert_eq!(shape, [16, 3, 8, 8]);
    assert_eq!(
        tensors.tensor("projector.net.1.num_batches_tracked").unwrap().dtype(),
        safetensors::Dtype::I64
    );
}

#[test]
fn a_failed_save_keeps_the_old_file() {
    let folder = Folder::new();
    let path = folder.path("missing/run.safetensors");
    let error = checkpoint::save(&path, &model(1, |_| {}), &About::default(), None).unwrap_err();
    assert!(matches!(error, CheckpointError::Io { verb: "write", .. }), "{error}");
}

#[test]
fn both_layouts_are_exported_and_imported() {
    let folder = Folder::new();
    let (model, _) = trained();
    for (layout, key) in [
        (KeyLayout::Transformers5, "encoder.layers.1.attention.q_proj.weight"),
        (KeyLayout::Transformers4, "encoder.encoder.layer.1.attention.attention.query.weight"),
    ] {
        let path = folder.path("export.safetensors");
        checkpoint::export(&path, &model, layout).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let tensors = SafeTensors::deserialize(&bytes).unwrap();
        assert!(tensors.tensor(key).is_ok(), "{key}");
        assert_eq!(
            bits(&checkpoint::import(&path, &ImportOptions::default(), &Device::Cpu).unwrap()),
            bits(&model)
        );

        // The same without our metadata: the sizes are read off the shapes.
        let path = folder.path("bare.safetensors");
        safetensors::serialize_to_file(tensors.iter(), None, &path).unwrap();
        let imported = checkpoint::import(&path, &MICRO, &Device::Cpu).unwrap();
        assert_eq!(bits(&imported), bits(&model));
        assert_eq!(imported.architecture().config().encoder, model.architecture().config().encoder);
        // A head width that does not divide is an error and not another model.
        let error = checkpoint::import(&path, &ImportOptions::default(), &Device::Cpu).unwrap_err();
        assert!(error.to_string().contains("head width 64"), "{error}");
    }
}

/// Splits a file into the JSON of its header and its data.
fn parts(bytes: &[u8]) -> (serde_json::Value, &[u8]) {
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    (serde_json::from_slice(&bytes[8..8 + length]).unwrap(), &bytes[8 + length..])
}

fn join(header: &str, data: &[u8]) -> Vec<u8> {
    [&(header.len() as u64).to_le_bytes(), header.as_bytes(), data].concat()
}

/// Saves a good checkpoint, lets `edit` change header and data, and returns the error of loading the result.
fn attacked(edit: impl FnOnce(&mut serde_json::Value, &mut Vec<u8>)) -> CheckpointError {
    let folder = Folder::new();
    let path = folder.path("run.safetensors");
    let (model, optimizer) = trained();
    checkpoint::save(&path, &model, &about(), Some(&optimizer)).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let (mut header, data) = parts(&bytes);
    let mut data = data.to_vec();
    edit(&mut header, &mut data);
    load(&folder.write("bad.safetensors", &join(&header.to_string(), &data))).unwrap_err()
}

const BIAS: &str = "projector.net.3.bias";

#[test]
fn lying_headers_are_refused() {
    let format = |error: CheckpointError| match error {
        CheckpointError::Format { cause, .. } => cause,
        other => panic!("{other}"),
    };
    let error = format(attacked(|header, _| header[BIAS]["data_offsets"] = serde_json::json!([0, 64])));
    assert!(matches!(error, FormatError::Misplaced { .. }), "{error}");
    let error =
        format(attacked(|header, _| header[BIAS]["shape"] = serde_json::json!([1u64 << 40, 1u64 << 40])));
    assert!(matches!(error, FormatError::Size { .. }) && error.to_string().contains("2^64"), "{error}");
    let error = format(attacked(|header, _| header[BIAS]["shape"] = serde_json::json!([15])));
    assert!(matches!(error, FormatError::Size { .. }), "{error}");
    let error = format(attacked(|header, _| header[BIAS]["dtype"] = serde_json::json!("F8_E4M3")));
    assert!(matches!(error, FormatError::Dtype { .. }), "{error}");
    let error = format(attacked(|header, _| header[BIAS]["colour"] = serde_json::json!("red")));
    assert!(matches!(error, FormatError::Header { .. }), "{error}");
    let error = format(attacked(|_, data| data.truncate(data.len() - 1)));
    assert!(matches!(error, FormatError::Length { .. }), "{error}");
    let error = format(attacked(|_, data| data.push(0)));
    assert!(matches!(error, FormatError::Length { .. }), "{error}");
}

#[test]
fn wrong_tensors_are_refused() {
    let named = |error: CheckpointError, parts: &[&str]| {
        let text = error.to_string();
        assert!(parts.iter().all(|part| text.contains(part)), "{text}");
    };
    // Same bytes, other shape.
    let error = attacked(|header, _| header[BIAS]["shape"] = serde_json::json!([4, 4]));
    named(error, &["shape mismatch", BIAS, "[16]", "[4, 4]"]);
    let rename = |header: &mut serde_json::Value, from: &str, to: &str| {
        let entry = header.as_object_mut().unwrap().remove(from).unwrap();
        header[to] = entry;
    };
    named(attacked(|header, _| rename(header, BIAS, "projector.net.9.bias")), &["projector.net.9.bias"]);
    let moment = "optimizer.first.projector.net.3.bias";
    named(
        attacked(|header, _| rename(header, moment, "optimizer.first.nothing")),
        &["optimizer.first.nothing"],
    );
    named(
        attacked(|header, _| rename(header, moment, "optimizer.third.projector.net.3.bias")),
        &["both moments"],
    );
    named(attacked(|header, _| header["__metadata__"]["gawm.version"] = "2".into()), &["version 1", "\"2\""]);
    named(
        attacked(|header, _| {
            let text = header["__metadata__"]["gawm.architecture"].as_str().unwrap();
            let huge = text.replace("\"latent_width\":16", "\"latent_width\":999999999999");
            header["__metadata__"]["gawm.architecture"] = huge.into();
        }),
        &["latent_width", "999999999999"],
    );
    named(
        attacked(|header, _| {
            let text = header["__metadata__"]["gawm.architecture"].as_str().unwrap();
            header["__metadata__"]["gawm.architecture"] = text.replace("\"depth\":2", "\"depth\":200").into();
        }),
        &["missing tensor", "encoder.layers.10"],
    );
    named(attacked(|header, _| header["__metadata__"]["gawm.optimizer"] = "{}".into()), &["gawm.optimizer"]);
    let poison = |value: f32| {
        move |header: &mut serde_json::Value, data: &mut Vec<u8>| {
            let begin = header[BIAS]["data_offsets"][0].as_u64().unwrap() as usize + 3 * 4;
            data[begin..begin + 4].copy_from_slice(&value.to_le_bytes());
        }
    };
    named(attacked(poison(f32::NAN)), &["non-finite", BIAS, "NaN at element 3"]);
    named(attacked(poison(f32::NEG_INFINITY)), &["non-finite", BIAS, "-inf at element 3"]);
    let negative = |header: &mut serde_json::Value, data: &mut Vec<u8>| {
        let entry = &header["optimizer.second.projector.net.3.bias"];
        let begin = entry["data_offsets"][0].as_u64().unwrap() as usize;
        data[begin..begin + 4].copy_from_slice(&(-1f32).to_le_bytes());
    };
    named(attacked(negative), &["second moment", BIAS]);
}

#[test]
fn files_that_are_no_checkpoints_are_refused() {
    let folder = Folder::new();
    let check = |bytes: &[u8], part: &str| {
        let error = load(&folder.write("bad.safetensors", bytes)).unwrap_err().to_string();
        assert!(error.contains(part), "{error}");
    };
    check(b"", "expected 8 bytes");
    check(&[1, 2, 3], "expected 8 bytes");
    check(&u64::MAX.to_le_bytes(), "header too long");
    check(&(10u64 << 20).to_le_bytes(), "truncated header");
    check(&join("no json", b""), "malformed header");
    check(&join(&"[".repeat(100_000), b""), "malformed header");
    check(&join("{}", b""), "not a gawm checkpoint");
    let twice = r#"{"a":{"dtype":"U8","shape":[1],"data_offsets":[0,1]},"a":{"dtype":"U8","shape":[1],"data_offsets":[0,1]}}"#;
    check(&join(twice, b"x"), "occurs twice");
    let backwards = r#"{"a":{"dtype":"U8","shape":[1],"data_offsets":[1,0]}}"#;
    check(&join(backwards, b"x"), "size mismatch");
    let error = load(&folder.path("nothing")).unwrap_err();
    assert!(matches!(error, CheckpointError::Io { verb: "read", .. }), "{error}");
}

/// A checkpoint cut or changed anywhere gives an error or the model of a changed number, and never a panic.
#[test]
fn random_damage_never_panics() {
    let folder = Folder::new();
    let path = folder.path("run.safetensors");
    let (model, optimizer) = trained();
    checkpoint::save(&path, &model, &about(), Some(&optimizer)).unwrap();
    let good = std::fs::read(&path).unwrap();
    let header = 8 + u64::from_le_bytes(good[..8].try_into().unwrap()) as usize;
    let mut stream = gawm_model::Stream::new(1, "damage", 0);
    for _ in 0..300 {
        let mut bad = good.clone();
        let at = stream.below(header as u32) as usize;
        bad[at] ^= 1 << stream.below(8);
        if stream.below(4) == 0 {
            bad.truncate(stream.below(good.len() as u32) as usize);
        }
        // Some damage is invisible: a flipped bit in a note, a space for a space.
        load(&folder.write("bad.safetensors", &bad)).ok();
    }
}

/// One instruction of a pickle.
fn text(value: &str) -> Vec<u8> {
    [b"X".as_slice(), &(value.len() as u32).to_le_bytes(), value.as_bytes()].concat()
}

fn int(value: i32) -> Vec<u8> {
    [b"J".as_slice(), &value.to_le_bytes()].concat()
}

fn tuple(items: &[i32]) -> Vec<u8> {
    [b"(".to_vec(), items.iter().flat_map(|&item| int(item)).collect(), b"t".to_vec()].concat()
}

/// The pickle of one tensor as torch writes it.
fn tensor(storage: &str, len: i32, offset: i32, shape: &[i32], stride: &[i32]) -> Vec<u8> {
    [
        b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec(),
        text("storage"),
        b"ctorch\nFloatStorage\n".to_vec(),
        text(storage),
        text("cpu"),
        int(len),
        b"tQ".to_vec(),
        int(offset),
        tuple(shape),
        tuple(stride),
        b"\x89ccollections\nOrderedDict\n)RtR".to_vec(),
    ]
    .concat()
}

fn state_dict(entries: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let entries = entries.iter().flat_map(|(name, value)| [text(name), value.clone()].concat()).collect();
    [b"\x80\x02ccollections\nOrderedDict\n)R(".to_vec(), entries, b"u.".to_vec()].concat()
}

fn archive(path: &Path, files: &[(&str, &[u8])], method: zip::CompressionMethod) {
    let mut archive = zip::ZipWriter::new(std::fs::File::create(path).unwrap());
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    for (name, bytes) in files {
        archive.start_file(format!("archive/{name}"), options).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap();
}

/// Writes a model as torch does: a pickle, and one storage per tensor.
fn torch_file(path: &Path, model: &WorldModel, method: zip::CompressionMethod) {
    let mut entries = Vec::new();
    let mut storages = Vec::new();
    for (index, (name, value)) in model.parameters().iter().enumerate() {
        let shape: Vec<i32> = value.dims().iter().map(|&dim| dim as i32).collect();
        let stride: Vec<i32> = value.stride().iter().map(|&stride| stride as i32).collect();
        let (mut pickle, mut bytes) =
            (tensor(&index.to_string(), value.elem_count() as i32, 0, &shape, &stride), vec![]);
        if value.dtype() == gawm_model::DType::I64 {
            let at = pickle.windows(12).position(|window| window == b"FloatStorage").unwrap();
            pickle.splice(at..at + 12, *b"LongStorage");
            bytes.extend(value.to_scalar::<i64>().unwrap().to_le_bytes());
        } else {
            // Written transposed, with the strides that say so.
            let (transposed, swap) = match value.rank() {
                2 => (value.t().unwrap(), true),
                _ => (value.clone(), false),
            };
            let values = transposed.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
            if swap {
                pickle = tensor(&index.to_string(), value.elem_count() as i32, 0, &shape, &[1, shape[0]]);
            }
        }
        entries.push((name.to_owned(), pickle));
        storages.push((format!("data/{index}"), bytes));
    }
    let entries: Vec<(&str, Vec<u8>)> =
        entries.iter().map(|(name, pickle)| (name.as_str(), pickle.clone())).collect();
    let pickle = state_dict(&entries);
    let mut files: Vec<(&str, &[u8])> = vec![("data.pkl", &pickle), ("byteorder", b"little")];
    files.extend(storages.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())));
    archive(path, &files, method);
}

#[test]
fn torch_files_are_imported() {
    let folder = Folder::new();
    let (model, _) = trained();
    let path = folder.path("weights.pt");
    torch_file(&path, &model, zip::CompressionMethod::Stored);
    assert_eq!(bits(&checkpoint::import(&path, &MICRO, &Device::Cpu).unwrap()), bits(&model));
    torch_file(&path, &model, zip::CompressionMethod::Deflated);
    let error = checkpoint::import(&path, &MICRO, &Device::Cpu).unwrap_err();
    match error {
        CheckpointError::Torch { cause, .. } => {
            assert!(matches!(*cause, TorchError::Compressed { .. }), "{cause}")
        }
        other => panic!("{other}"),
    }
}

#[test]
fn pickles_that_are_no_state_dicts_are_refused() {
    let folder = Folder::new();
    let path = folder.path("bad.pt");
    let check = |pickle: &[u8], part: &str| {
        archive(&path, &[("data.pkl", pickle), ("data/0", &[0; 16])], zip::CompressionMethod::Stored);
        let error = checkpoint::import(&path, &MICRO, &Device::Cpu).unwrap_err().to_string();
        assert!(error.contains(part), "{error}");
    };
    check(b"\x80\x02cos\nsystem\nX\x02\x00\x00\x00ls\x85R.", "os.system");
    check(&[b"\x80\x04".to_vec(), b"\x8c\x05posix\x8c\x06system\x93.".to_vec()].concat(), "posix.system");
    check(b"\x80\x02c__builtin__\neval\nX\x01\x00\x00\x001\x85R.", "__builtin__.eval");
    check(b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n.", "expected a dict as the result");
    check(b"\x80\x02)\x81.", "refused pickle instruction 0x81");
    check(b"", "truncated");
    check(b"X\xff\xff\xff\xffabc", "truncated");
    check(b"\x80\x02(((((t", "truncated");
    check(b"R", "a value on the stack");
    check(b"u", "a mark on the stack");
    check(b"h\x07", "a remembered value");
    check(b"\x8a\x09123456789", "64 bits");
    check(&[b"c".as_slice(), &[b'a'; 100_000]].concat(), "line of at most 255");
    check(&b")\x85".repeat(500_000), "truncated"); // deep nesting costs memory in proportion and no stack
    let deep = [b")".to_vec(), vec![0x85; 1_000_000], b".".to_vec()].concat();
    check(&deep, "expected a dict as the result");
    check(&state_dict(&[("a", int(3))]), "\"a\" is not a tensor");
    let good = tensor("0", 4, 0, &[2, 2], &[2, 1]);
    check(&state_dict(&[("a", good.clone()), ("a", good.clone())]), "occurs twice");
    check(&state_dict(&[("a", good)]), "no published world model");
    for (offset, shape, stride) in [
        (1, vec![2, 2], vec![2, 1]),
        (0, vec![5], vec![1]),
        (0, vec![i32::MAX, i32::MAX, i32::MAX, 2], vec![0, 0, 0, 0]),
        (0, vec![1_000_000], vec![0]),
        (0, vec![2], vec![i32::MAX]),
    ] {
        check(
            &state_dict(&[("a", tensor("0", 4, offset, &shape, &stride))]),
            "does not fit into its storage",
        );
    }
    check(&state_dict(&[("a", tensor("0", 4, -1, &[2], &[1]))]), "the arguments of a tensor");
    check(&state_dict(&[("a", tensor("0", -4, 0, &[2], &[1]))]), "a storage of numbers");
}

#[test]
fn archives_that_lie_are_refused() {
    let folder = Folder::new();
    let (model, _) = trained();
    let path = folder.path("weights.pt");
    let import = |path: &Path| checkpoint::import(path, &MICRO, &Device::Cpu).map(|_| ());
    torch_file(&path, &model, zip::CompressionMethod::Stored);
    let good = std::fs::read(&path).unwrap();
    let mut stream = gawm_model::Stream::new(1, "zip damage", 0);
    for _ in 0..300 {
        let mut bad = good.clone();
        // Mostly the directory at the end and the pickle at the beginning.
        let at = if stream.below(2) == 0 {
            good.len() - 1 - stream.below(4000) as usize
        } else {
            stream.below(20_000) as usize
        };
        bad[at] ^= 1 << stream.below(8);
        import(&folder.write("bad.pt", &bad)).ok();
    }
    import(&folder.write("bad.pt", &good[..good.len() / 2])).unwrap_err();
    import(&folder.write("bad.pt", b"PK\x03\x04")).unwrap_err();
    let pickle = state_dict(&[("a", tensor("0", 4, 0, &[4], &[1]))]);
    archive(&path, &[("data.pkl", &pickle), ("byteorder", b"big")], zip::CompressionMethod::Stored);
    assert!(import(&path).unwrap_err().to_string().contains("little-endian"));
    archive(&path, &[("weights", b"")], zip::CompressionMethod::Stored);
    assert!(import(&path).unwrap_err().to_string().contains("one data.pkl"));
}
