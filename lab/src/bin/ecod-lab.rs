//! The program `ecod-lab`.

fn main() -> std::process::ExitCode {
    ecod_lab::cli::main()
}
