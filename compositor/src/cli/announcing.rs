//! Announces the wall in the network, so that render servers find it without an address.

use std::io;

use channel::{discovery::Announcement, key::Key};
use tokio::net::TcpListener;

use super::args::WallArgs;
use crate::window::host_name;

/// Announces a wall until the announcement is dropped. `None` if it must not, if nobody else can reach the wall, or if the
/// network does not let it: the wall runs without, too.
///
/// # Errors
/// The listener has no address.
pub(crate) fn announce(args: &WallArgs, listener: &TcpListener, key: Option<&Key>) -> io::Result<Option<Announcement>> {
    let address = listener.local_addr()?;
    if args.no_announce || address.ip().to_canonical().is_loopback() {
        return Ok(None);
    }
    let name = format!("{} {}", host_name(), address.port());
    let announced = Announcement::new(&name, address, key);
    match &announced {
        Ok(_) => tracing::info!("announced in the network as \"{name}\"; --no-announce keeps the wall silent"),
        Err(error) => tracing::warn!("the wall is not announced, so name its address to render servers: {error}"),
    }
    Ok(announced.ok())
}
