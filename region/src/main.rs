//! The program `ecod-region`.

fn main() -> std::process::ExitCode {
    ecod_region::cli::main()
}
