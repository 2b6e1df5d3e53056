//! `ecod-lab` as its users run it. Some runs measure time: what keeps processors busy is tested in `accuracy`.

mod bench;
mod demo;
mod errors;
mod eval;
mod help;
mod report;
