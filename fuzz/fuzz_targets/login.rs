//! First packets of a client that the broker has not authenticated.

#![no_main]

use ecod_actors::transport::broker::read_connect_packet;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|sent: &[u8]| {
    if let Some(length) = read_connect_packet(sent) {
        assert_eq!(
            read_connect_packet(&sent[..length]),
            Some(length),
            "nothing beyond the packet is read"
        );
    }
});
