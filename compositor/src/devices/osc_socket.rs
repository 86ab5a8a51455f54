//! Hears OSC on a UDP socket, and bounds what strangers can do there: rate, size, and lines of the log.

use std::{
    net::{IpAddr, SocketAddr},
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use tokio::net::{UdpSocket, lookup_host};

use super::{
    Link, Order,
    osc::{self, LONGEST_PACKET},
};
use crate::{
    farm::{LogLimit, RateLimit},
    remote::message::Action,
};

/// Messages that act at once…
const BURST: u32 = 500;
/// …and the pause between further ones: as many in a second as two remotes may send.
const INTERVAL: Duration = Duration::from_millis(2);
const TOO_MANY: &str = "too many messages at once";
/// The system reports errors of earlier packets; they are no reason to spin.
const ERROR_PAUSE: Duration = Duration::from_millis(100);

/// Binds the socket.
///
/// # Errors
/// HOST:PORT is no address, is taken, or is open to the network without leave.
pub(super) async fn listen(address: &str, is_open: bool) -> anyhow::Result<UdpSocket> {
    let resolved = lookup_host(address).await.with_context(|| {
        format!("--osc {address} is no address or name of this machine: write it as HOST:PORT, as in 127.0.0.1:7190")
    })?;
    let addresses: Vec<SocketAddr> = resolved.collect();
    if !is_open && !addresses.iter().all(|address| address.ip().to_canonical().is_loopback()) {
        bail!(
            "--osc {address} is open to the network, and OSC has no passwords: add --osc-open if you trust everybody there, \
             or listen on 127.0.0.1"
        );
    }
    UdpSocket::bind(&addresses[..]).await.with_context(|| {
        format!("--osc cannot listen on {address}: choose another port, or an address of this machine")
    })
}

/// Passes on what controllers say, until it is dropped.
pub(super) async fn hear(socket: UdpSocket, link: Link) {
    let start = Instant::now();
    let mut guard = Guard::new();
    // One byte more than the longest packet reveals a longer one.
    let mut packet = vec![0; LONGEST_PACKET + 1];
    loop {
        match socket.recv_from(&mut packet).await {
            Ok((n_bytes, peer)) => {
                let line = guard
                    .admit(start.elapsed(), peer.ip(), &packet[..n_bytes], |action| link.order(Order::Act(action)));
                line.into_iter().for_each(|line| tracing::warn!("{line}"));
            }
            Err(error) => {
                tracing::debug!("OSC: {error}");
                tokio::time::sleep(ERROR_PAUSE).await;
            }
        }
    }
}

/// Bounds what controllers do. Pure: time is an argument.
struct Guard {
    rate: RateLimit,
    log: LogLimit<IpAddr>,
}

impl Guard {
    fn new() -> Self {
        Self { rate: RateLimit::new(BURST, INTERVAL), log: LogLimit::of_controllers() }
    }

    /// Gives the actions in a packet to `order`, which returns whether there is room for more. Returns a line for the log if
    /// something was ignored, now and then.
    fn admit(
        &mut self,
        now: Duration,
        peer: IpAddr,
        packet: &[u8],
        mut order: impl FnMut(Action) -> bool,
    ) -> Option<String> {
        let mut fault = None;
        if self.passes(now) {
            // The packet itself has passed, and with it its first message.
            let mut has_passed = true;
            osc::decode(packet, &mut |outcome| {
                let outcome = outcome.and_then(|action| match has_passed || self.passes(now) {
                    true if order(action) => Ok(()),
                    true => Err("the wall is busy".to_owned()),
                    false => Err(TOO_MANY.to_owned()),
                });
                has_passed = false;
                fault = outcome.err().or(fault.take());
            });
        } else {
            fault = Some(TOO_MANY.to_owned());
        }
        let fault = fault?;
        self.log.admit(now, peer).map(|more| format!("ignored OSC of {peer}: {fault}{more}"))
    }

    fn passes(&mut self, now: Duration) -> bool {
        let passes = self.rate.wait(now).is_zero();
        if passes {
            self.rate.count(now);
        }
        passes
    }
}

#[cfg(test)]
mod tests {
    use rosc::{OscBundle, OscMessage, OscPacket, OscTime, encoder};

    use super::*;

    const PEER: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);

    fn message() -> OscPacket {
        OscPacket::Message(OscMessage { addr: "/raywall/view-all".to_owned(), args: Vec::new() })
    }

    #[test]
    fn the_network_is_heard_only_with_leave() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let fault = |address: &str| format!("{:#}", runtime.block_on(listen(address, false)).unwrap_err());
        assert!(fault("0.0.0.0:0").contains("--osc-open"));
        assert!(fault("nowhere").contains("HOST:PORT"));
        assert!(runtime.block_on(listen("127.0.0.1:0", false)).is_ok());
        assert!(runtime.block_on(listen("0.0.0.0:0", true)).is_ok());
    }

    #[test]
    fn a_flood_passes_at_its_rate_and_ends_with_the_flood() {
        let packet = encoder::encode(&message()).unwrap();
        let mut guard = Guard::new();
        let mut admit = |milliseconds| {
            let mut n_orders = 0;
            let now = Duration::from_millis(milliseconds);
            let line = guard.admit(now, PEER, &packet, |_| {
                n_orders += 1;
                true
            });
            (n_orders, line)
        };
        // 100 messages each millisecond for two seconds.
        let flood: Vec<_> = (0..200_000).map(|index| admit(1000 + index / 100)).collect();
        let n_orders: usize = flood.iter().map(|(n_orders, _)| n_orders).sum();
        assert!((1480..=1520).contains(&n_orders), "{n_orders}");
        let lines: Vec<_> = flood.into_iter().filter_map(|(_, line)| line).collect();
        assert!(lines.len() == 5 && lines[0].ends_with(TOO_MANY), "{lines:?}");
        assert_eq!(admit(3100), (1, None), "nothing is left of it");
    }

    #[test]
    fn each_message_of_a_bundle_counts() {
        let bundle = OscBundle { timetag: OscTime { seconds: 0, fractional: 1 }, content: vec![message(); 100] };
        let packet = encoder::encode(&OscPacket::Bundle(bundle)).unwrap();
        let (mut guard, mut n_orders) = (Guard::new(), 0);
        for _ in 0..10 {
            guard.admit(Duration::ZERO, PEER, &packet, |_| {
                n_orders += 1;
                true
            });
        }
        assert_eq!(n_orders, 500);
    }

    #[test]
    fn nonsense_costs_few_lines_and_disturbs_nobody() {
        let mut guard = Guard::new();
        let lines = (0..3600)
            .filter_map(|second| guard.admit(Duration::from_secs(second), PEER, b"nonsense", |_| panic!("no action")));
        let lines: Vec<_> = lines.collect();
        assert!(lines.len() < 70, "{}", lines.len());
        assert_eq!(lines[0], "ignored OSC of 127.0.0.1: no OSC packet");
        assert!(lines.last().is_some_and(|line| line.contains("more like this before")), "{lines:?}");
        assert!(
            guard.admit(Duration::from_secs(3600), PEER, &encoder::encode(&message()).unwrap(), |_| true).is_none()
        );
    }
}
