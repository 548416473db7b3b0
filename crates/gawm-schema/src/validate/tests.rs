use super::*;

fn schema(text: &str) -> Schema {
    toml::from_str(&format!("rate_hz = 10.0\nstreams = []\n{text}")).unwrap()
}

fn state(name: &str, part: &str) -> String {
    format!(
        "[[features]]\nname = {name:?}\nrole = \"state\"\ndata = {{ type = \"vector\", dtype = \"float32\", parts = [{part}] }}\n"
    )
}

fn dims(names: &[&str]) -> String {
    let dims: Vec<String> = names
        .iter()
        .map(|name| format!("{{ name = {name:?}, unit = \"rad\", source = \"/t:x\" }}"))
        .collect();
    format!("dims = [{}]", dims.join(", "))
}

fn linear(names: &[&str]) -> String {
    format!("{{ kind = \"linear\", {} }}", dims(names))
}

#[track_caller]
fn check_refused(text: &str, expected: fn(&SchemaError) -> bool) {
    let error = schema(text).validate().unwrap_err();
    assert!(expected(&error), "{error:?}");
}

#[test]
fn a_possible_schema_passes_and_its_hash_is_stable() {
    let text = state("observation.state", &linear(&["a", "b"]));
    let one = schema(&text);
    one.validate().unwrap();
    assert_eq!(one.hash(), schema(&text).hash());
    let other = schema(&state("observation.state", &linear(&["a", "c"])));
    assert_ne!(one.hash(), other.hash());
    let (place, here, there) = one.difference(&other).unwrap();
    assert_eq!(place, "schema.features[0].data.parts[0].dims[1].name");
    assert_eq!((here.as_str(), there.as_str()), ("\"b\"", "\"c\""));
    assert_eq!(one.difference(&one), None);
}

#[test]
fn impossible_schemas_are_refused() {
    assert_eq!(schema("features = []").validate(), Err(SchemaError::NoFeature));
    let name = |e: &SchemaError| matches!(e, SchemaError::Name { .. });
    check_refused(&state("a/b", &linear(&["x"])), name);
    check_refused(&state("index", &linear(&["x"])), name);
    check_refused(&state("gawm.state", &linear(&["x"])), name);
    check_refused(&state("", &linear(&["x"])), name);
    check_refused(&state("s", &linear(&["bell"]).replace("bell", "\\u0007")), name);
    let duplicate = |e: &SchemaError| matches!(e, SchemaError::Duplicate { .. });
    check_refused(&state("s", &linear(&["x", "x"])), duplicate);
    check_refused(&format!("{}{}", state("s", &linear(&["x"])), state("s", &linear(&["y"]))), duplicate);
    check_refused(&state("s", ""), |e| matches!(e, SchemaError::NoDims { .. }));
    check_refused(
        &state("s", &format!("{{ kind = \"quaternion\", order = \"xyzw\", {} }}", dims(&["x", "y", "z"]))),
        |e| matches!(e, SchemaError::PartWidth { raw_width: 4, got: 3, part: 0, .. }),
    );
    check_refused(
        &state(
            "s",
            "{ kind = \"linear\", dims = [{ name = \"x\", unit = \"m\", source = \"\", limits = [1.0, 1.0] }] }",
        ),
        |e| matches!(e, SchemaError::Limits { .. }),
    );
    check_refused(
        "[[features]]\nname = \"c\"\nrole = \"image\"\ndata = { type = \"image\", height = 0, width = 4, channels = 3 }",
        |e| matches!(e, SchemaError::ImageSize { height: 0, .. }),
    );
    check_refused(
        "[[features]]\nname = \"c\"\nrole = \"state\"\ndata = { type = \"image\", height = 4, width = 4, channels = 3 }",
        |e| matches!(e, SchemaError::RoleData { holds: "images", .. }),
    );
    let mut rate = schema(&state("s", &linear(&["x"])));
    rate.rate_hz = f64::NAN;
    assert!(matches!(rate.validate(), Err(SchemaError::Rate { .. })));
}
