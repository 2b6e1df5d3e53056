//! `ecod-video`: frames of videos, network cameras and pipelines for `ecod-node`, which starts it.

fn main() -> std::process::ExitCode {
    ecod_actors::camera::frame_source::video::program::main()
}
