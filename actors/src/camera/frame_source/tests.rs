use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::time::Duration;

use opencv::core::{CV_8UC3, Mat, MatTraitConst, Scalar, Size, Vec3b, Vector};
use opencv::imgcodecs;
use opencv::prelude::*;
use opencv::videoio::VideoWriter;

use super::*;

fn gray(value: u8) -> Mat {
    Mat::new_rows_cols_with_default(48, 64, CV_8UC3, Scalar::all(f64::from(value))).unwrap()
}

fn brightness(frame: &CameraFrame) -> u8 {
    frame.image.at_2d::<Vec3b>(24, 32).unwrap()[1]
}

fn open(toml: &str) -> Result<Box<dyn FrameSource>, FrameError> {
    toml::from_str::<SourceConfig>(toml).unwrap().open(Duration::from_secs(5))
}

/// Brightness of all frames up to the error that ends them.
fn play(source: &mut dyn FrameSource) -> (Vec<u8>, FrameError) {
    let mut seen = Vec::new();
    loop {
        match source.next_frame() {
            Ok(frame) => seen.push(brightness(&frame)),
            Err(error) => return (seen, error),
        }
    }
}

fn write_images(directory: &Path) {
    for (number, value) in [50, 100, 150].into_iter().enumerate() {
        assert!(imgcodecs::imwrite_def(directory.join(format!("f{number:03}.png")), &gray(value)).unwrap());
    }
    std::fs::write(directory.join("notes.txt"), "not an image").unwrap();
}

#[test]
fn images_come_in_order_from_a_directory_and_from_a_pattern() {
    let directory = tempfile::tempdir().unwrap();
    write_images(directory.path());
    for path in [directory.path().to_owned(), directory.path().join("f%03d.png")] {
        let mut source = open(&format!("kind = 'images'\npath = {path:?}\nfps = 500.0")).unwrap();
        let (seen, end) = play(source.as_mut());
        assert_eq!(seen, [50, 100, 150], "{path:?}");
        assert_eq!(end, FrameError::Ended { origin: path.display().to_string() });

        let mut source = open(&format!("kind = 'images'\npath = {path:?}\nfps = 500.0\nlooping = true")).unwrap();
        let seen: Vec<u8> = (0..5).map(|_| brightness(&source.next_frame().unwrap())).collect();
        assert_eq!(seen, [50, 100, 150, 50, 100]);
    }
}

#[test]
fn a_bad_image_is_passed_over_and_the_rest_is_played() {
    let directory = tempfile::tempdir().unwrap();
    write_images(directory.path());
    std::fs::write(directory.path().join("f001.png"), "half a fi").unwrap();
    let mut source = open(&format!("kind = 'images'\npath = {:?}\nfps = 500.0", directory.path())).unwrap();
    let mut played = Vec::new();
    loop {
        match source.next_frame() {
            Ok(frame) => played.push(brightness(&frame).to_string()),
            Err(FrameError::Ended { .. }) => break,
            Err(error) => played.push(error.to_string()),
        }
    }
    assert_eq!((&*played[0], &*played[2], played.len()), ("50", "150", 3));
    assert!(played[1].contains("f001.png") && played[1].contains("not an image"), "{}", played[1]);
}

#[test]
fn images_keep_their_rate() {
    let directory = tempfile::tempdir().unwrap();
    write_images(directory.path());
    let mut source = open(&format!("kind = 'images'\npath = {:?}\nfps = 20.0", directory.path())).unwrap();
    let started = Instant::now();
    play(source.as_mut());
    assert!(started.elapsed() >= Duration::from_millis(100), "three frames are two periods of 50 ms apart");
}

#[test]
fn a_video_file_plays_once_or_again_and_again() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("clip.avi");
    let mjpg = VideoWriter::fourcc('M', 'J', 'P', 'G').unwrap();
    let mut writer = VideoWriter::new(&path, mjpg, 200.0, Size::new(64, 48), true).unwrap();
    assert!(writer.is_opened().unwrap());
    let values = [40, 120, 200];
    values.iter().for_each(|value| writer.write(&gray(*value)).unwrap());
    writer.release().unwrap();

    let near = |seen: &[u8], expected: &[u8]| {
        seen.len() == expected.len() && seen.iter().zip(expected).all(|(a, b)| a.abs_diff(*b) <= 4)
    };
    let mut source = open(&format!("kind = 'video'\npath = {path:?}")).unwrap();
    let (seen, end) = play(source.as_mut());
    assert!(near(&seen, &values), "{seen:?}");
    assert_eq!(end, FrameError::Ended { origin: path.display().to_string() });

    let mut source = open(&format!("kind = 'video'\npath = {path:?}\nlooping = true")).unwrap();
    let seen: Vec<u8> = (0..5).map(|_| brightness(&source.next_frame().unwrap())).collect();
    assert!(near(&seen, &[40, 120, 200, 40, 120]), "{seen:?}");
}

#[test]
fn a_pipeline_gives_frames() {
    let pipeline = "videotestsrc num-buffers=3 pattern=white ! video/x-raw,width=64,height=48 ! videoconvert ! \
                    video/x-raw,format=BGR ! appsink";
    let mut source = open(&format!("kind = 'gstreamer'\npipeline = '{pipeline}'")).unwrap();
    let (seen, end) = play(source.as_mut());
    assert_eq!(seen.len(), 3);
    assert!(seen.iter().all(|value| *value > 230), "{seen:?}");
    assert!(matches!(end, FrameError::Lost { .. }), "a live source does not end: {end}");
}

/// A network camera on a free port that answers whoever asks as `answer` does; its address.
fn network_camera(answer: impl Fn(TcpStream) -> std::io::Result<()> + Send + 'static) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://user:secret@{}/stream", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for visitor in listener.incoming() {
            // One that hangs up is none of the camera's business.
            let _ = visitor.and_then(&answer);
        }
    });
    url
}

/// Motion JPEG over HTTP, the way cheap network cameras speak.
fn motion_jpeg(mut visitor: TcpStream) -> std::io::Result<()> {
    let request = BufReader::new(visitor.try_clone()?);
    let lines: Vec<String> = request.lines().map_while(Result::ok).take_while(|line| !line.is_empty()).collect();
    if !lines.iter().any(|line| line.starts_with("Authorization: Basic ")) {
        return write!(visitor, "HTTP/1.1 401 Unauthorized\r\nWWW-Authenticate: Basic realm=\"camera\"\r\n\r\n");
    }
    write!(visitor, "HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=frame\r\n\r\n")?;
    for value in (0..25).map(|number| 50 + 4 * number) {
        let mut jpeg = Vector::<u8>::new();
        imgcodecs::imencode_def(".jpg", &gray(value), &mut jpeg).unwrap();
        write!(visitor, "--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", jpeg.len())?;
        visitor.write_all(jpeg.as_slice())?;
        write!(visitor, "\r\n")?;
    }
    Ok(())
}

#[test]
fn a_network_camera_gives_frames_until_it_hangs_up() {
    let url = network_camera(motion_jpeg);
    let mut source = open(&format!("kind = 'url'\nurl = '{url}'")).unwrap();
    let (seen, end) = play(source.as_mut());
    assert!(seen.len() > 20 && seen.is_sorted() && seen[0].abs_diff(50) <= 4, "{seen:?}");
    let FrameError::Lost { origin, .. } = end else { panic!("a live source does not end: {end}") };
    assert!(origin.ends_with("/stream") && !origin.contains("secret"), "{origin}");
}

#[test]
fn a_network_camera_that_says_nothing_is_given_up_in_time() {
    let held = std::sync::Mutex::new(Vec::new());
    let url = network_camera(move |visitor| {
        held.lock().unwrap().push(visitor);
        Ok(())
    });
    let source: SourceConfig = toml::from_str(&format!("kind = 'url'\nurl = '{url}'")).unwrap();
    let asked = Instant::now();
    let error = source.open(Duration::from_millis(300)).err().expect("nothing comes").to_string();
    assert!(asked.elapsed() < Duration::from_secs(30), "it has a limit of its own");
    assert!(error.starts_with("cannot open http://127.0.0.1") && !error.contains("secret"), "{error}");
}

#[test]
fn what_cannot_be_opened_is_named_with_its_reason() {
    let empty = tempfile::tempdir().unwrap();
    let text = empty.path().join("clip.avi");
    std::fs::write(&text, "not a video").unwrap();
    for (config, name, reason) in [
        ("kind = 'v4l2'\ndevice = '/dev/video-none'".into(), "/dev/video-none", "No such file"),
        ("kind = 'video'\npath = 'no/such.avi'".into(), "no/such.avi", "No such file"),
        ("kind = 'images'\npath = 'no/such/directory'".into(), "no/such/directory", "No such file"),
        ("kind = 'images'\npath = 'frames/%s.png'".into(), "frames/%s.png", "%d"),
        (format!("kind = 'images'\npath = {:?}", empty.path()), "", "no images"),
        (format!("kind = 'video'\npath = {text:?}"), "clip.avi", "no video"),
    ] {
        let error = open(&config).err().expect("cannot be opened").to_string();
        assert!(error.starts_with("cannot open ") && error.contains(name) && error.contains(reason), "{error}");
    }
}

#[test]
fn bad_configuration_is_refused() {
    assert!(toml::from_str::<SourceConfig>("kind = 'video'\npath = 'a'\nspeed = 2").is_err(), "unknown key");
    let pipeline: SourceConfig = toml::from_str("kind = 'gstreamer'\npipeline = 'videotestsrc'").unwrap();
    assert_eq!(pipeline.validate().expect_err("no appsink").key, "pipeline");
    let camera: SourceConfig = toml::from_str("kind = 'v4l2'\nwidth = 0").unwrap();
    assert_eq!(camera.validate().expect_err("no width").key, "width");
    let images: SourceConfig = toml::from_str("kind = 'images'\npath = 'a'\nfps = 0.0").unwrap();
    assert_eq!(images.validate().expect_err("no rate").key, "fps");
}
