//! `ecod-video`: reads videos, network cameras and pipelines for `ecod-node`, which starts this
//! program.

fn main() -> std::process::ExitCode {
    ecod_actors::camera::frame_source::video::program::main()
}
