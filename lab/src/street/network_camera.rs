//! A camera of the street on the network: MJPEG over HTTP, as IP cameras send it.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::Context;
use ecod::model::time::Timestamp;
use ecod_actors::platform::clock;
use opencv::core::{Mat, Vector};
use opencv::imgcodecs::{IMWRITE_JPEG_QUALITY, imencode};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::watch;
use tokio::task::{JoinHandle, spawn_blocking};

use super::view::StreetView;
use super::{Street, StreetCamera};
use crate::testbed::camera::sensor::Sensor;

/// Number of pictures that the camera sends per second.
pub const FRAMES_PER_S: f64 = 5.0;

/// Quality of the sent pictures.
const QUALITY: i32 = 90;

/// Bytes that wait for a vehicle in this process's socket.
const SEND_BUFFER: u32 = 1 << 14;

/// Time after which a picture is too old to be sent.
const LATEST: Duration = Duration::from_millis(20);

type Jpeg = Arc<Vec<u8>>;

/// A camera that renders and serves its pictures.
pub struct NetworkCamera {
    address: SocketAddr,
    end: EndOnDrop,
    thread: JoinHandle<anyhow::Result<()>>,
}

/// Ends thread and server of a camera that is given up, so that the program can end.
struct EndOnDrop {
    ended: Arc<AtomicBool>,
    server: JoinHandle<()>,
}

impl Drop for EndOnDrop {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
        self.server.abort();
    }
}

impl NetworkCamera {
    /// Starts the camera; second zero of the street is `start`. Each camera takes its pictures at
    /// its own phase, a share of the time between two pictures.
    ///
    /// # Errors
    /// Returns an error if no port is free, or a placard cannot be drawn.
    pub async fn start(
        street: &Arc<Street>,
        number: usize,
        start: Timestamp,
    ) -> anyhow::Result<Self> {
        let socket = TcpSocket::new_v4()?;
        // A slow vehicle should miss pictures instead of getting old ones.
        socket.set_send_buffer_size(SEND_BUFFER)?;
        socket
            .bind((Ipv4Addr::LOCALHOST, 0).into())
            .context("no free port on loopback")?;
        let listener = socket.listen(8)?;
        let address = listener.local_addr()?;
        let (newest, pictures) = watch::channel(Jpeg::default());
        let ended = Arc::<AtomicBool>::default();
        let phase = number as f64 / street.cameras.len() as f64;
        let view = StreetView::new(street)?;
        let shoot = Shooting {
            street: Arc::clone(street),
            number,
            view,
            start,
            phase,
            newest,
        };
        let thread = spawn_blocking({
            let ended = Arc::clone(&ended);
            move || shoot.run(&ended)
        });
        let end = EndOnDrop {
            ended,
            server: tokio::spawn(serve(listener, pictures)),
        };
        Ok(Self {
            address,
            end,
            thread,
        })
    }

    /// Address from which the camera's pictures are read.
    pub fn url(&self) -> String {
        format!("http://{}/video", self.address)
    }

    /// Ends the camera.
    ///
    /// # Errors
    /// Returns an error if a picture could not be rendered.
    pub async fn stop(self) -> anyhow::Result<()> {
        drop(self.end);
        self.thread
            .await
            .context("a camera of the street has failed")?
    }
}

/// State of the thread that takes the pictures of a camera.
struct Shooting {
    street: Arc<Street>,
    number: usize,
    view: StreetView,
    start: Timestamp,
    phase: f64,
    newest: watch::Sender<Jpeg>,
}

impl Shooting {
    /// Each picture is rendered before its time and sent at its time, so that no vehicle takes the
    /// time of rendering for a delay.
    fn run(self, ended: &AtomicBool) -> anyhow::Result<()> {
        let camera: &StreetCamera = &self.street.cameras[self.number];
        let mut sensor = None;
        let mut frame = 0;
        let mut takes = Duration::ZERO;
        while !ended.load(Ordering::Relaxed) {
            let began = clock::now();
            // A machine that is too slow shows fewer pictures, each at its time.
            let soonest_s = (began + takes).since(self.start).as_secs_f64();
            frame = frame.max((soonest_s * FRAMES_PER_S - self.phase).ceil().max(0.0) as u64);
            let at_s = (frame as f64 + self.phase) / FRAMES_PER_S;
            let taken_at = self.start + Duration::from_secs_f64(at_s);
            let still = self.view.render(&self.street, camera, at_s)?;
            let sensor = sensor.get_or_insert_with(|| Sensor::new(&still, self.number as u64));
            let picture = sensor.expose(&still, frame)?;
            let jpeg = encode(&picture)?;
            takes = clock::now().since(began);
            thread::sleep(taken_at.since(clock::now()));
            if clock::now().since(taken_at) < LATEST {
                self.newest.send_replace(Arc::new(jpeg));
            }
            frame += 1;
        }
        Ok(())
    }
}

fn encode(picture: &Mat) -> opencv::Result<Vec<u8>> {
    let mut jpeg = Vector::new();
    imencode(
        ".jpg",
        picture,
        &mut jpeg,
        &Vector::from_slice(&[IMWRITE_JPEG_QUALITY, QUALITY]),
    )?;
    Ok(jpeg.into())
}

async fn serve(listener: TcpListener, pictures: watch::Receiver<Jpeg>) {
    while let Ok((client, _)) = listener.accept().await {
        // A disconnecting client is not a fault of the camera.
        tokio::spawn(send(client, pictures.clone()));
    }
}

/// Sends each picture once it is available, independent of the client's request.
async fn send(mut client: TcpStream, mut pictures: watch::Receiver<Jpeg>) -> std::io::Result<()> {
    client.set_nodelay(true)?;
    let mut request = [0; 1024];
    // The content of the request makes no difference.
    let _ = client.read(&mut request).await?;
    client
        .write_all(
            b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=picture\r\n\r\n",
        )
        .await?;
    while pictures.changed().await.is_ok() {
        let jpeg = Jpeg::clone(&pictures.borrow_and_update());
        let header = format!(
            "--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n",
            jpeg.len()
        );
        client.write_all(header.as_bytes()).await?;
        client.write_all(&jpeg).await?;
        client.write_all(b"\r\n").await?;
    }
    Ok(())
}
