//! The line by which a render server joins the wall.

use std::{
    net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket},
    path::Path,
};

use channel::key::make_key_command;

use crate::overlay::JoinHint;

/// The command by which a render server joins the wall that listens on `address`, and a note on where it works.
///
/// `key` is the wall's key file; `model` and `sky` are the files that the wall shows and is lit by, if there are any.
pub(crate) fn join_hint(address: SocketAddr, key: Option<&Path>, [model, sky]: [Option<&Path>; 2]) -> JoinHint {
    let port = address.port();
    let is_local = address.ip().is_loopback();
    let own_address = || own_address().map_or_else(host_name, |ip| ip.to_string());
    let host = if address.ip().is_unspecified() { own_address() } else { address.ip().to_string() };
    let host = if host.contains(':') { format!("[{host}]") } else { host };
    let mut command = format!("renderer connect {host}:{port}");
    let mut note = match (is_local, key) {
        (false, _) => "On this machine, or on any that reaches it.".to_owned(),
        (true, Some(_)) => {
            format!(
                "On this machine. To let other machines reach the wall, add --listen 0.0.0.0:{port} to its options."
            )
        }
        (true, None) => format!(
            "On this machine. To let other machines reach the wall, make a key with `{}`, and start it with \
             --listen 0.0.0.0:{port} --key wall.key.",
            make_key_command("wall.key".as_ref())
        ),
    };
    if let Some(key) = key {
        command += &format!(" --key {}", shell_word(key));
        note += " The key file must be on the render server's machine.";
    } else if !is_local {
        command += " --insecure";
    }
    if let Some(model) = model {
        command += &format!(" --model {}", shell_word(model));
        note += " The model is read from the render server's own disk.";
    }
    if let Some(sky) = sky {
        command += &format!(" --sky {}", shell_word(sky));
    }
    JoinHint { command, note }
}

/// The absolute path of a file, quoted for a shell.
fn shell_word(path: &Path) -> String {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let text = path.to_string_lossy();
    // Only a NUL cannot be quoted, and no path holds one.
    shlex::try_quote(&text).map_or_else(|_| text.to_string(), Into::into)
}

/// The address by which this machine reaches others, if it has a network.
pub(crate) fn own_address() -> Option<IpAddr> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
    // Sends nothing: connecting only chooses a route. The target is an address for documents (RFC 5737).
    socket.connect((Ipv4Addr::new(192, 0, 2, 1), 9)).ok()?;
    let ip = socket.local_addr().ok()?.ip();
    (!ip.is_loopback() && !ip.is_unspecified()).then_some(ip)
}

/// This machine's name in the network, as far as the system knows it.
pub(crate) fn host_name() -> String {
    std::fs::read_to_string("/proc/sys/kernel/hostname")
        .ok()
        .map(|name| name.trim().to_owned())
        .filter(|name| !name.is_empty())
        .unwrap_or_else(|| "THIS-MACHINE".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_to_join_can_be_typed_as_it_stands() {
        let hint = |address: &str| join_hint(address.parse().expect(address), None, [None; 2]);
        assert_eq!(hint("127.0.0.1:7117").command, "renderer connect 127.0.0.1:7117");
        let note = hint("127.0.0.1:7117").note;
        assert!(note.contains("--listen 0.0.0.0:7117 --key wall.key") && !note.contains("--insecure"), "{note}");
        assert_eq!(hint("10.1.2.3:80").command, "renderer connect 10.1.2.3:80 --insecure");
        assert_eq!(hint("[fe80::1]:80").command, "renderer connect [fe80::1]:80 --insecure");
        let any = hint("0.0.0.0:7117").command;
        assert!(any.ends_with(":7117 --insecure") && !any.contains("0.0.0.0"), "{any}");
        let files = ["/models/it's a dragon.ply", "/day.hdr"].map(|path| Some(Path::new(path)));
        let with_files = join_hint(([127, 0, 0, 1], 80).into(), None, files);
        let words = shlex::split(&with_files.command).expect("a shell can read it");
        assert_eq!(words[..3], ["renderer", "connect", "127.0.0.1:80"]);
        assert_eq!(words[3..], ["--model", "/models/it's a dragon.ply", "--sky", "/day.hdr"]);
    }

    #[test]
    fn a_wall_with_a_key_is_joined_with_the_key() {
        let hint = |ip| join_hint((ip, 80).into(), Some(Path::new("/keys/wall.key")), [None; 2]);
        assert_eq!(hint([10, 1, 2, 3]).command, "renderer connect 10.1.2.3:80 --key /keys/wall.key");
        assert_eq!(hint([127, 0, 0, 1]).command, "renderer connect 127.0.0.1:80 --key /keys/wall.key");
        for ip in [[10, 1, 2, 3], [127, 0, 0, 1]] {
            assert!(!hint(ip).note.contains("--insecure"), "a wall with a key refuses render servers without it");
        }
    }
}
