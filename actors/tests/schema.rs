//! The JSON Schemas in `docs/schemas` are those of the code.

use std::path::Path;

const REGENERATE: &str = "regenerate with: ECOD_WRITE_SCHEMAS=1 cargo test -p ecod-actors --test schema";

#[test]
fn documented_schemas_are_those_of_the_code() {
    let directory = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/schemas"));
    let schemas = ecod::wire::schemas();
    for (name, schema) in &schemas {
        let file = directory.join(format!("{name}.json"));
        let current = serde_json::to_string_pretty(schema).unwrap() + "\n";
        if std::env::var_os("ECOD_WRITE_SCHEMAS").is_some() {
            std::fs::write(&file, &current).unwrap();
        }
        let documented = std::fs::read_to_string(&file).unwrap_or_default();
        assert!(documented == current, "{} is out of date; {REGENERATE}", file.display());
    }
    let documented = std::fs::read_dir(directory).unwrap().count();
    assert_eq!(documented, schemas.len(), "a schema of no payload in {}", directory.display());
}
