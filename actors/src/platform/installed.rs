//! Files that a package has put beside the program.

use std::path::PathBuf;

/// File or directory below the prefix under which the program is installed: of `/usr/bin/ecod-node` that is `/usr`. None
/// where there is none, as beside a program that was built by hand.
pub(crate) fn path(below_prefix: &str) -> Option<PathBuf> {
    let program = std::env::current_exe().ok()?;
    Some(program.parent()?.parent()?.join(below_prefix)).filter(|path| path.exists())
}
