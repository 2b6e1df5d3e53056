//! `ecod-node`: a node of a cell, and the tools around it.

fn main() -> std::process::ExitCode {
    ecod_actors::cli::main()
}
