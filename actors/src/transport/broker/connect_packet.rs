//! The CONNECT packet of a client.

use std::ops::RangeInclusive;

use tokio::io::{AsyncRead, AsyncReadExt};

use super::client_rejection::ClientRejection;

/// A CONNECT packet as received.
#[derive(Debug)]
pub(super) struct ConnectPacket {
    pub(super) packet: Vec<u8>,
    /// The client id; empty if the broker should generate one, and if rmqtt will find the packet
    /// malformed.
    pub(super) client_id: String,
    /// True if the client id is empty, so that the broker draws one.
    pub(super) has_generated_id: bool,
}

/// Maximum length of a CONNECT packet in bytes: client id, last will, user name and password.
const MAX_BYTES: usize = 16 * 1024;

const CONNECT: u8 = 0x10;

/// The protocol level of MQTT 5, in which properties come before the client id.
const MQTT_5: u8 = 5;

/// Protocol levels of MQTT 3.1, 3.1.1 and 5.
const LEVELS: RangeInclusive<u8> = 3..=MQTT_5;

/// CONNACK with the return code "unacceptable protocol version" (MQTT 3.1.1, 3.2.2.3). A bridge of
/// mosquitto first sends level 0x84, and after this answer 4.
pub(super) const UNKNOWN_VERSION: [u8; 4] = [0x20, 2, 0, 1];

/// Reads the rest of the first packet, which must be CONNECT. rmqtt itself would wait for its first
/// bytes forever.
pub(super) async fn read(
    first: u8,
    stream: &mut (impl AsyncRead + Unpin),
) -> Result<ConnectPacket, ClientRejection> {
    if first != CONNECT {
        return Err(ClientRejection::Malformed);
    }
    let mut packet = vec![CONNECT];
    let mut length = 0;
    for shift in [0, 7, 14] {
        let byte = stream.read_u8().await?;
        packet.push(byte);
        length |= usize::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            break;
        }
    }
    if packet.last().is_some_and(|byte| byte & 0x80 != 0) || length > MAX_BYTES {
        return Err(ClientRejection::Malformed);
    }
    let mut body = vec![0; length];
    stream.read_exact(&mut body).await?;
    if let Some(level) = level(&body).filter(|level| !LEVELS.contains(level)) {
        return Err(ClientRejection::UnknownVersion(level));
    }
    let id_bytes = client_id(&body);
    let has_generated_id = id_bytes.is_some_and(<[u8]>::is_empty);
    let client_id = String::from_utf8_lossy(id_bytes.unwrap_or_default()).into_owned();
    packet.append(&mut body);
    Ok(ConnectPacket {
        packet,
        client_id,
        has_generated_id,
    })
}

/// Length of the first packet in received bytes, if it is complete. Only built for the fuzz
/// targets.
#[cfg(fuzzing)]
pub fn read_connect_packet(sent: &[u8]) -> Option<usize> {
    use futures_util::FutureExt;

    let (first, mut rest) = sent.split_first()?;
    let login = read(*first, &mut rest)
        .now_or_never()
        .expect("bytes that are there are not waited for")
        .ok()?;
    assert!(
        sent.starts_with(&login.packet),
        "rmqtt gets what the client sent"
    );
    Some(login.packet.len())
}

/// The protocol level in the body of a CONNECT packet.
fn level(body: &[u8]) -> Option<u8> {
    text(body)?.1.first().copied()
}

/// The client id in the body of a CONNECT packet; `None` if rmqtt will find the packet malformed.
fn client_id(body: &[u8]) -> Option<&[u8]> {
    let (_protocol, rest) = text(body)?;
    // Level, flags and the keep-alive.
    let (fixed, mut rest) = rest.split_at_checked(4)?;
    if fixed.first() == Some(&MQTT_5) {
        let mut length = 0;
        for shift in [0, 7, 14, 21] {
            let (byte, after) = rest.split_first()?;
            rest = after;
            length |= usize::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                break;
            }
        }
        rest = rest.get(length..)?;
    }
    text(rest).map(|(id, _)| id)
}

/// Splits a length-prefixed text from the rest.
fn text(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk::<2>()?;
    rest.split_at_checked(u16::from_be_bytes(*length).into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn unknown_protocol_is_not_malformed() {
        for (level, name) in [(0x84, "MQTT"), (0x83, "MQIsdp"), (6, "MQTT"), (0, "MQTT")] {
            let body = [
                &[0, name.len() as u8],
                name.as_bytes(),
                &[level, 2, 0, 60, 0, 1, b'x'],
            ]
            .concat();
            let packet = [&[body.len() as u8], &body[..]].concat();
            let refusal = read(CONNECT, &mut &packet[..]).await.unwrap_err();
            assert!(
                matches!(refusal, ClientRejection::UnknownVersion(found) if found == level),
                "{refusal}"
            );
        }
    }

    #[tokio::test]
    async fn clients_without_id_are_recognised() {
        let v4 = |id: &str| {
            [
                &b"\0\x04MQTT\x04\x02\0\x3c\0"[..],
                &[id.len() as u8],
                id.as_bytes(),
            ]
            .concat()
        };
        // With a session expiry of an hour.
        let v5 = |id: &str| {
            [
                &b"\0\x04MQTT\x05\x02\0\x3c\x05\x11\0\0\x0e\x10\0"[..],
                &[id.len() as u8],
                id.as_bytes(),
            ]
            .concat()
        };
        let drawn = "0123456789abcdef0123456789abcdef";
        for (body, has_generated_id) in [
            (v4(""), true),
            (v5(""), true),
            (v4("euclid"), false),
            (v5("euclid"), false),
            (v4(drawn), false),
        ] {
            let packet = [&[CONNECT, body.len() as u8], &body[..]].concat();
            let login = read(packet[0], &mut &packet[1..]).await.unwrap();
            assert_eq!(
                (login.packet, login.has_generated_id),
                (packet, has_generated_id)
            );
        }
        for body in [
            &b""[..],
            b"\0\x04MQ",
            b"\0\x04MQTT\x05\x02\0\x3c\xff\xff\xff\xff",
            b"\0\x04MQTT\x04\x02\0\x3c\0",
        ] {
            assert_eq!(client_id(body), None);
        }
    }
}
