//! The way to a broker, which can be blocked without its ends noticing.

use std::net::SocketAddr;
use std::sync::Arc;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// An address at which connections are passed on to a broker; open until dropped.
pub(crate) struct Path {
    pub(crate) address: SocketAddr,
    is_blocked: Arc<watch::Sender<bool>>,
    task: JoinHandle<()>,
}

impl Path {
    pub(crate) async fn to(broker: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let is_blocked = Arc::new(watch::Sender::new(false));
        let blocked = Arc::clone(&is_blocked);
        let task = tokio::spawn(async move {
            while let Ok((near, _)) = listener.accept().await {
                let Ok(far) = TcpStream::connect(broker).await else {
                    continue;
                };
                let (near_in, near_out) = near.into_split();
                let (far_in, far_out) = far.into_split();
                tokio::spawn(pass(near_in, far_out, blocked.subscribe()));
                tokio::spawn(pass(far_in, near_out, blocked.subscribe()));
            }
        });
        Self {
            address,
            is_blocked,
            task,
        }
    }

    pub(crate) fn block(&self, is_blocked: bool) {
        self.is_blocked.send_replace(is_blocked);
    }
}

impl Drop for Path {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn pass(
    mut from: OwnedReadHalf,
    mut to: OwnedWriteHalf,
    mut is_blocked: watch::Receiver<bool>,
) {
    let mut buffer = vec![0; 64 * 1024];
    while let Ok(read @ 1..) = from.read(&mut buffer).await {
        if is_blocked.wait_for(|is_blocked| !is_blocked).await.is_err()
            || to.write_all(&buffer[..read]).await.is_err()
        {
            return;
        }
    }
}
