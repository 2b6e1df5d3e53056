//! The rooms of the house: modules of each crate by floor, read from the code. Imports run downward, without a circle.
//!
//! A room is a module of a crate's root. The rooms of a folder are its modules. Tests are omitted.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use syn::visit::{self, Visit};

/// A module: the crate and the names below it.
type Module = Vec<String>;

/// Crates by name in paths, and their sources.
const CRATES: [(&str, &str); 6] = [
    ("ecod", "src"),
    ("ecod_actors", "actors/src"),
    ("ecod_client", "clients/rust/src"),
    ("ecod_interop", "interop/src"),
    ("ecod_lab", "lab/src"),
    ("ecod_region", "region/src"),
];

#[test]
fn imports_have_no_cycle() {
    let house = House::read(Path::new(env!("CARGO_MANIFEST_DIR")));
    assert!(house.imports.len() > 100, "the sources were read");
    let mut circles = Vec::new();
    for parent in house.parents() {
        let rooms = house.rooms(&parent);
        println!("{}, {} rooms", parent.join("::"), rooms.len());
        match floors(&rooms) {
            Ok(floors) => {
                for (number, floor) in floors.iter().enumerate().rev() {
                    println!("  {:>2}  {}", number + 1, floor.join(" "));
                }
            }
            Err(circle) => circles.push(house.explain(&parent, &circle)),
        }
    }
    assert!(
        circles.is_empty(),
        "rooms that import each other:\n{}",
        circles.concat()
    );
}

/// Names of which every actor or program has one.
const IDIOMS: [&str; 6] = ["Arguments", "Cli", "Command", "Error", "Msg", "State"];

#[test]
fn type_names_are_unique() {
    let house = House::read(Path::new(env!("CARGO_MANIFEST_DIR")));
    let mut named = BTreeMap::<String, BTreeSet<&Module>>::new();
    for (module, path) in &house.modules {
        let file = syn::parse_file(&fs::read_to_string(path).unwrap()).unwrap();
        for item in file.items {
            let (name, attributes) = match item {
                syn::Item::Struct(item) => (item.ident, item.attrs),
                syn::Item::Enum(item) => (item.ident, item.attrs),
                syn::Item::Trait(item) => (item.ident, item.attrs),
                syn::Item::Type(item) => (item.ident, item.attrs),
                _ => continue,
            };
            // Items with `cfg` are alternatives of one item.
            if !attributes
                .iter()
                .any(|attribute| attribute.path().is_ident("cfg"))
            {
                named.entry(name.to_string()).or_default().insert(module);
            }
        }
    }
    named.retain(|name, modules| modules.len() > 1 && !IDIOMS.contains(&name.as_str()));
    assert!(
        named.is_empty(),
        "type names that mean several things: {named:#?}"
    );
}

/// Folders of tests in addition to the crates' sources.
const TESTS: [&str; 6] = [
    "tests",
    "actors/tests",
    "clients/rust/tests",
    "interop/tests",
    "lab/tests",
    "region/tests",
];

/// Maximum of the median number of words in the name of a test, and of the number itself.
const MEDIAN_WORDS: usize = 5;
const MAX_WORDS: usize = 8;

#[test]
fn test_names_are_short() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut names = TestNames::default();
    for folder in CRATES.iter().map(|(_, sources)| sources).chain(&TESTS) {
        names.read(&root.join(folder));
    }
    names.0.sort_by_key(|name| words(name));
    assert!(names.0.len() > 1000, "the sources were read");
    let longest = names.0.last().unwrap();
    assert!(words(longest) <= MAX_WORDS, "{longest}");
    let median = &names.0[names.0.len() / 2];
    assert!(
        words(median) <= MEDIAN_WORDS,
        "half of the names are longer than {median}"
    );
}

fn words(name: &str) -> usize {
    name.split('_').count()
}

/// Names of functions with an attribute `test`, also one of tokio.
#[derive(Default)]
struct TestNames(Vec<String>);

impl TestNames {
    fn read(&mut self, folder: &Path) {
        for path in fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().path())
        {
            if path.is_dir() {
                self.read(&path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let file = syn::parse_file(&fs::read_to_string(path).unwrap()).unwrap();
                self.visit_file(&file);
            }
        }
    }
}

impl<'ast> Visit<'ast> for TestNames {
    fn visit_item_fn(&mut self, function: &'ast syn::ItemFn) {
        let is_test = function.attrs.iter().any(|attribute| {
            let last = attribute.path().segments.last();
            last.is_some_and(|segment| segment.ident == "test")
        });
        if is_test {
            self.0.push(function.sig.ident.to_string());
        }
    }
}

#[test]
fn cycle_is_found_and_named() {
    let graph = |edges: &[(&str, &str)]| {
        let mut graph = BTreeMap::<String, BTreeSet<String>>::new();
        for (from, to) in edges {
            graph
                .entry((*from).into())
                .or_default()
                .insert((*to).into());
            graph.entry((*to).into()).or_default();
        }
        graph
    };
    let tower = floors(&graph(&[
        ("roof", "hall"),
        ("hall", "cellar"),
        ("roof", "cellar"),
    ]));
    assert_eq!(
        tower,
        Ok(vec![
            vec!["cellar".into()],
            vec!["hall".into()],
            vec!["roof".into()]
        ])
    );
    let knot = floors(&graph(&[
        ("roof", "hall"),
        ("hall", "attic"),
        ("attic", "hall"),
        ("hall", "cellar"),
    ]));
    assert_eq!(knot, Err(BTreeSet::from(["attic".into(), "hall".into()])));
}

/// All modules and their imports.
struct House {
    /// Every module, with the file of each; a folder holds further modules.
    modules: BTreeMap<Module, PathBuf>,
    /// Importing module, imported module.
    imports: BTreeSet<(Module, Module)>,
}

impl House {
    fn read(root: &Path) -> Self {
        let mut modules = BTreeMap::new();
        for (name, sources) in CRATES {
            collect(&root.join(sources), &[name.to_owned()], &mut modules);
        }
        let mut imports = BTreeSet::new();
        for (module, path) in &modules {
            let file = syn::parse_file(&fs::read_to_string(path).unwrap()).unwrap();
            let mut reader = Reader {
                module,
                modules: &modules,
                imports: &mut imports,
            };
            reader.visit_file(&file);
        }
        Self { modules, imports }
    }

    /// Modules whose children are rooms: the crates and all folders.
    fn parents(&self) -> BTreeSet<Module> {
        self.modules
            .keys()
            .filter(|module| module.len() > 1)
            .map(|module| module[..module.len() - 1].to_vec())
            .collect()
    }

    /// The rooms of a parent, each with the rooms that it imports.
    fn rooms(&self, parent: &Module) -> BTreeMap<String, BTreeSet<String>> {
        let room = |module: &Module| {
            (module.len() > parent.len() && module.starts_with(parent))
                .then(|| module[parent.len()].clone())
        };
        let mut rooms: BTreeMap<_, BTreeSet<_>> = self
            .modules
            .keys()
            .filter_map(room)
            .map(|name| (name, BTreeSet::new()))
            .collect();
        for (from, to) in &self.imports {
            if let (Some(from), Some(to)) = (room(from), room(to))
                && from != to
            {
                rooms.entry(from).or_default().insert(to);
            }
        }
        rooms
    }

    /// The imports that tie a circle.
    fn explain(&self, parent: &Module, circle: &BTreeSet<String>) -> String {
        let inside = |module: &Module| {
            module.len() > parent.len()
                && module.starts_with(parent)
                && circle.contains(&module[parent.len()])
        };
        let tied = self.imports.iter().filter(|(from, to)| {
            inside(from) && inside(to) && from[parent.len()] != to[parent.len()]
        });
        tied.map(|(from, to)| format!("  {} -> {}\n", from.join("::"), to.join("::")))
            .collect()
    }
}

/// Rooms by floor, the lowest first; or the rooms that lie on a circle or between two.
fn floors(
    rooms: &BTreeMap<String, BTreeSet<String>>,
) -> Result<Vec<Vec<String>>, BTreeSet<String>> {
    let mut placed = BTreeSet::new();
    let mut floors = Vec::new();
    while placed.len() < rooms.len() {
        let floor: Vec<_> = rooms
            .iter()
            .filter(|(room, imports)| !placed.contains(*room) && imports.is_subset(&placed))
            .map(|(room, _)| room.clone())
            .collect();
        if floor.is_empty() {
            return Err(tied(rooms, &placed));
        }
        placed.extend(floor.iter().cloned());
        floors.push(floor);
    }
    Ok(floors)
}

/// Rooms that are not placed and that a room of the same kind imports.
fn tied(rooms: &BTreeMap<String, BTreeSet<String>>, placed: &BTreeSet<String>) -> BTreeSet<String> {
    let mut left: BTreeSet<_> = rooms
        .keys()
        .filter(|room| !placed.contains(*room))
        .cloned()
        .collect();
    loop {
        let imported: BTreeSet<_> = left
            .iter()
            .flat_map(|room| rooms[room].intersection(&left))
            .cloned()
            .collect();
        if imported.len() == left.len() {
            return left;
        }
        left = imported;
    }
}

/// Notes the modules of a folder; `lib.rs` is the crate itself.
fn collect(folder: &Path, parent: &[String], modules: &mut BTreeMap<Module, PathBuf>) {
    let Ok(entries) = fs::read_dir(folder) else {
        return;
    };
    for path in entries.map(|entry| entry.unwrap().path()) {
        let stem = path.file_stem().unwrap().to_str().unwrap().to_owned();
        if stem == "tests" || stem == "bin" {
            continue;
        }
        let module = if stem == "lib" {
            parent.to_vec()
        } else {
            [parent, &[stem]].concat()
        };
        if path.is_dir() {
            collect(&path, &module, modules);
        } else if path.extension().is_some_and(|extension| extension == "rs")
            && path.file_stem().unwrap() != "main"
        {
            modules.insert(module, path);
        }
    }
}

/// Reads the imports of one file.
struct Reader<'a> {
    module: &'a Module,
    modules: &'a BTreeMap<Module, PathBuf>,
    imports: &'a mut BTreeSet<(Module, Module)>,
}

impl Reader<'_> {
    /// Notes the module that a path leads to.
    fn record(&mut self, path: &[String]) {
        let Some(first) = path.first() else { return };
        let mut target = match first.as_str() {
            "crate" => vec![self.module[0].clone()],
            "self" => self.module.clone(),
            "super" => self.module[..self.module.len() - 1].to_vec(),
            name if CRATES.iter().any(|(known, _)| *known == name) => vec![name.to_owned()],
            _ => [self.module.as_slice(), std::slice::from_ref(first)].concat(),
        };
        if !self.modules.contains_key(&target) {
            return;
        }
        for name in &path[1..] {
            if name == "super" {
                target.pop();
                continue;
            }
            target.push(name.clone());
            if !self.modules.contains_key(&target) {
                target.pop();
                break;
            }
        }
        self.imports.insert((self.module.clone(), target));
    }

    fn record_tree(&mut self, before: &[String], tree: &syn::UseTree) {
        let with = |name: &syn::Ident| [before, &[name.to_string()]].concat();
        match tree {
            syn::UseTree::Path(path) => self.record_tree(&with(&path.ident), &path.tree),
            syn::UseTree::Name(name) => self.record(&with(&name.ident)),
            syn::UseTree::Rename(rename) => self.record(&with(&rename.ident)),
            syn::UseTree::Glob(_) => self.record(before),
            syn::UseTree::Group(group) => group
                .items
                .iter()
                .for_each(|tree| self.record_tree(before, tree)),
        }
    }
}

impl<'ast> Visit<'ast> for Reader<'_> {
    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        self.record_tree(&[], &item.tree);
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let names: Vec<_> = path
            .segments
            .iter()
            .map(|segment| segment.ident.to_string())
            .collect();
        if names.len() > 1 {
            self.record(&names);
        }
        visit::visit_path(self, path);
    }

    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        let is_test = item.attrs.iter().any(|attribute| {
            attribute.path().is_ident("cfg")
                && attribute
                    .meta
                    .require_list()
                    .is_ok_and(|list| list.tokens.to_string() == "test")
        });
        if !is_test {
            visit::visit_item_mod(self, item);
        }
    }
}
