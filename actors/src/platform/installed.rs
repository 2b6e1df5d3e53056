//! Files that a package or a build has installed next to the program.

use std::path::PathBuf;

/// File or directory below the prefix under which the program is installed; for
/// `/usr/bin/ecod-node` the prefix is `/usr`. `None` if it does not exist, for example when run
/// from a build directory.
pub(crate) fn path(below_prefix: &str) -> Option<PathBuf> {
    let program = std::env::current_exe().ok()?;
    Some(program.parent()?.parent()?.join(below_prefix)).filter(|path| path.exists())
}

/// Another program of this project: at its place in a package, next to this program, or above the
/// directory of tests and examples.
pub(crate) fn program(name: &str) -> Option<PathBuf> {
    let here = std::env::current_exe().ok()?;
    let mut directory = here.parent()?;
    if directory.ends_with("deps") || directory.ends_with("examples") {
        directory = directory.parent()?;
    }
    Some(directory.join(name))
        .filter(|path| path.is_file())
        .or_else(|| path(&format!("lib/ecod-node/{name}")))
}
