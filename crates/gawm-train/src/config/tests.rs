use super::*;

const PIPELINE: &str = r#"
[ingest]
version = 1
[loader]
loaders = 2
[model]
preset = "nano"
[objectives]
preset = "sa-shuffled"
monitored = ["straightening"]
[train]
steps = 1200
rate = 1e-3
"#;

fn parse(text: &str, overrides: &[&str]) -> Result<Config, ConfigError> {
    let overrides =
        overrides.iter().map(|text| Override::of_pipeline(text)).collect::<Result<Vec<_>, _>>()?;
    Config::parse("p.toml", text, &overrides)
}

fn check_refused(text: &str, overrides: &[&str], expected: &[&str]) {
    let error = parse(text, overrides).unwrap_err().to_string();
    for part in expected {
        assert!(error.contains(part), "{text:?} {overrides:?}: {error:?} does not say {part:?}");
    }
}

#[test]
fn sections_and_overrides_are_read() {
    let config = parse(PIPELINE, &["train.rate=0.5", "model.encoder.depth=3", "train.device=cpu"]).unwrap();
    assert_eq!((config.train.steps, config.train.rate, config.loaders), (1200, 0.5, 2));
    assert_eq!((config.model.encoder.depth, config.model.encoder.width), (3, 64));
    assert_eq!(config.train.device, "cpu");
    assert_eq!(config.train.schedule().warmup_steps, 12);
}

#[test]
fn the_resolved_text_gives_the_same_configuration() {
    for overrides in
        [&[][..], &["train.warmup_steps=7", "train.supervised=[\"x\"]", "objectives.preset=pldm"]]
    {
        let config = parse(PIPELINE, overrides).unwrap();
        let text = config.to_toml();
        let again = parse(&text, &[]).unwrap();
        assert_eq!(
            (&again.model, &again.objectives, &again.train),
            (&config.model, &config.objectives, &config.train)
        );
        assert_eq!(again.to_toml(), text);
        assert_eq!(again.table["ingest"], config.table["ingest"]);
    }
}

#[test]
fn the_resolved_text_still_is_the_preset() {
    for name in gawm_model::objective::PRESETS {
        let preset = format!("objectives.preset={name}");
        let config = parse("", &[&preset, "objectives.monitored=[\"straightening\"]"]).unwrap();
        let again = parse(&config.to_toml(), &[]).unwrap();
        assert_eq!(again.objectives.preset_name(), Some(name));
        let weighted = parse("", &[&preset, "objectives.weights.prediction=0.5"]).unwrap();
        assert_eq!(weighted.objectives.preset_name(), None);
    }
}

#[test]
fn an_empty_file_is_the_published_setting() {
    let config = parse("", &[]).unwrap();
    assert_eq!(config.model, ModelConfig::default());
    assert_eq!(config.objectives, Objectives::default());
    assert_eq!((config.train.rate, config.train.weight_decay, config.loaders), (5e-5, 1e-3, 1));
}

#[test]
fn refused_values_have_place_expected_and_got() {
    check_refused("[train]\nstep = 3", &[], &["p.toml", "line 2", "step", "expected one of"]);
    check_refused("[train]\nsteps = \"many\"", &[], &["line 2", "expected u64", "many"]);
    check_refused("[trian]\nsteps = 3", &[], &["trian", "expected one of"]);
    check_refused("train = 3", &[], &["train"]);
    check_refused("[model]\nencoder.dept = 3", &[], &["[model]", "dept"]);
    check_refused("[objectives]\npreset = \"x\"", &[], &["[objectives]", "sa-idm"]);
    check_refused("[loader]\nloaders = 0", &[], &["[loader]", "1 to 1024", "got 0"]);
    check_refused("", &["train.step=3"], &["[train]", "step"]);
    check_refused("", &["train.steps"], &["no `=`"]);
    check_refused("", &["steps=3"], &["a section of sim"]);
    check_refused("[train]\nsteps = 1", &["train.steps.x=3"], &["steps", "integer"]);
    check_refused("[train", &[], &["line 1"]);
}

#[test]
fn all_values_out_of_range_are_listed_at_once() {
    let text = "[train]\nsteps = 0\nrate = -1.0\nmax_gradient_norm = nan\ndeadline_s = 0\nwarmup_steps = 5";
    check_refused(
        text,
        &[],
        &[
            "train.steps: expected 1 to 10^12, got 0",
            "train.rate: expected a number above 0, got -1",
            "max_gradient_norm",
            "NaN",
            "deadline_s",
            "warmup_steps: expected at most train.steps, got 5",
        ],
    );
}

#[test]
fn devices_that_are_not_there_are_refused() {
    for device in ["gpu", "cuda:x", "cuda:999"] {
        let train = TrainConfig { device: device.to_owned(), ..TrainConfig::default() };
        assert!(matches!(train.open_device(), Err(ConfigError::Device { .. })), "{device}");
    }
}
