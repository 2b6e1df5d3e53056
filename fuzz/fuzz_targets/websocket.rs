//! MQTT over WebSocket, as a stranger begins it and as a client goes on.
//!
//! The first byte of an input chooses whether the rest is all that is sent, frames after a handshake, or content for frames.

#![no_main]

use ecod_actors::transport::broker::read_websocket;
use libfuzzer_sys::fuzz_target;

/// A handshake without its first byte, which the broker reads to distinguish it from MQTT.
const HANDSHAKE: &[u8] = b"ET / HTTP/1.1\r\nHost: 127.0.0.1:1883\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: mqtt\r\n\r\n";

fuzz_target!(|input: &[u8]| {
    let Some((kind, bytes)) = input.split_first() else {
        return;
    };
    match kind % 3 {
        0 => drop(read_websocket(bytes.to_vec())),
        1 => {
            let content =
                read_websocket([HANDSHAKE, bytes].concat()).expect("the handshake is right");
            assert!(
                content.len() <= bytes.len(),
                "no client says more than it sends"
            );
        }
        _ => {
            let frames = bytes
                .chunks(1 + usize::from(kind / 3))
                .flat_map(|part| frame(part, *kind));
            let content = read_websocket(HANDSHAKE.iter().copied().chain(frames).collect());
            assert_eq!(content.as_deref(), Some(bytes), "it comes as it was sent");
        }
    }
});

/// A whole binary message of at most 125 bytes, masked.
fn frame(part: &[u8], mask: u8) -> Vec<u8> {
    let masked = part.iter().map(|byte| byte ^ mask);
    [0x82, 0x80 | part.len() as u8, mask, mask, mask, mask]
        .into_iter()
        .chain(masked)
        .collect()
}
