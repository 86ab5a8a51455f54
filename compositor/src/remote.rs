//! The remote: a page in a visitor's hand, and the same as an API, served by the wall.
//!
//! In reading order: [`message`] is a remote's wish, [`state`] the wall's answer; [`access`] and [`tokens`] say who comes in,
//! [`turns`] whose turn it is; [`hub`] lies between connections and wall; [`server`] bounds connections, which a
//! [`certificate`] encrypts, [`routes`] answers
//! requests and [`socket`] holds conversations; [`picture`] is the live picture, [`metrics`] are figures for Prometheus.
//!
//! All of it runs on a thread of its own, which sleeps while nobody asks and nothing changes. A bounded queue of orders leads
//! to the wall, and the latest state and picture lead back, so neither side ever waits for the other.

mod access;
mod certificate;
mod hub;
pub mod message;
mod metrics;
mod picture;
mod routes;
mod server;
mod socket;
pub mod state;
pub mod tokens;
mod turns;

use std::{
    net::{IpAddr, SocketAddr},
    path::PathBuf,
    sync::Arc,
    thread,
};

use anyhow::{Context, bail};
use tokio::{
    net::TcpListener,
    sync::{mpsc, oneshot},
};

use self::{access::Access, certificate::CertificateFile, hub::Hub, state::WallState, tokens::Token};
pub(crate) use self::{
    hub::{Order, Shown},
    picture::Thumbnail,
};

/// Orders that wait for the wall; more are refused.
const MOST_ORDERS: usize = 1024;

/// Where and to whom the remote is served.
#[derive(Clone, Debug)]
pub(crate) struct RemoteOptions {
    /// HOST:PORT.
    pub(crate) address: String,
    /// The file of tokens; without one, only this machine is served.
    pub(crate) tokens: Option<PathBuf>,
    /// The file of the certificate that encrypts the connections, if they are.
    pub(crate) certificate: Option<PathBuf>,
    /// Another name under which the wall is reached, as through a proxy.
    pub(crate) name: Option<String>,
    /// This machine's name and its address in the network, as far as they are known.
    pub(crate) host_name: String,
    pub(crate) own_address: Option<IpAddr>,
}

/// The wall's end of the remote. Dropping it ends all conversations.
#[derive(Debug)]
pub(crate) struct Remote {
    orders: mpsc::Receiver<Order>,
    hub: Arc<Hub>,
    link: String,
    certificate: Option<Arc<CertificateFile>>,
    /// Its end ends the thread.
    _running: oneshot::Sender<()>,
}

impl Remote {
    /// Serves remotes; `wake` is called when there are orders to take.
    ///
    /// # Errors
    /// The address is none, is taken, or is open to the network without tokens; or the file of tokens cannot be read.
    pub(crate) fn start(options: &RemoteOptions, wake: impl Fn() + Send + Sync + 'static) -> anyhow::Result<Self> {
        let RemoteOptions { address, tokens, certificate, name, host_name, own_address } = options;
        if let Some(path) = tokens {
            tokens::Tokens::read(path).with_context(|| match path.exists() {
                true => "--remote-tokens cannot be used".to_owned(),
                false => format!("no tokens: `compositor remote-token {} NAME` makes one", path.display()),
            })?;
        }
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .max_blocking_threads(1)
            .thread_name("pictures")
            .build()
            .context("cannot start the remote's thread")?;
        let listener = runtime.block_on(listen(address, tokens.is_some()))?;
        let local = listener.local_addr()?;
        let own = Token::random()?;
        let own_token = tokens.is_some().then(|| own.clone());
        let named = address.rsplit_once(':').map_or(address.as_str(), |(host, _)| host).to_owned();
        let names: Vec<_> =
            [host_name.clone(), format!("{host_name}.local"), named].into_iter().chain(name.clone()).collect();
        let certificate = certificate.as_ref().map(|path| {
            let addresses = [Some(local.ip()), *own_address].into_iter().flatten().map(|ip| ip.to_string());
            CertificateFile::read_or_make(path, &names.iter().cloned().chain(addresses).collect::<Vec<_>>())
        });
        let certificate = certificate.transpose()?.map(Arc::new);
        let place =
            place(&reachable(local, *own_address, host_name), name.as_deref(), local.port(), certificate.is_some());
        let link = own_token.map_or(place.clone(), |token| format!("{place}#{}", token.text()));
        let access = Access::new(names, tokens.clone().map(|path| (path, own)));
        let (sender, orders) = mpsc::channel(MOST_ORDERS);
        let hub = Arc::new(Hub::new(access, sender, Box::new(wake)));
        let (running, ended) = oneshot::channel();
        let served = Arc::clone(&hub);
        let seal = certificate.as_ref().map(|file| file.present().fingerprint);
        let served_certificate = certificate.clone();
        let serve = move || {
            runtime.block_on(async {
                tokio::select! {
                    () = server::serve(listener, served, served_certificate) => {}
                    _ = ended => {}
                }
            });
            runtime.shutdown_background();
        };
        thread::Builder::new().name("remote".to_owned()).spawn(serve).context("cannot start the remote's thread")?;
        let place = self::place(&reachable(local, *own_address, host_name), None, local.port(), seal.is_some());
        let seal = seal.map(|seal| format!(", with the certificate of SHA-256 {seal}")).unwrap_or_default();
        renderer::cli::say(format_args!("remote at {place}{seal}"))?;
        Ok(Self { orders, hub, link, certificate, _running: running })
    }

    /// The link that opens the remote, with the wall's own token of visitors if one is needed.
    pub(crate) fn link(&self) -> &str {
        &self.link
    }

    /// The SHA-256 of the certificate, if a wall made it.
    pub(crate) fn own_seal(&self) -> Option<String> {
        let certificate = self.certificate.as_ref()?.present();
        certificate.is_own.then_some(certificate.fingerprint)
    }

    /// The next order, if there is one.
    pub(crate) fn take(&mut self) -> Option<Order> {
        self.hub.orders_are_taken();
        self.orders.try_recv().ok()
    }

    /// Tells remotes the wall's state.
    pub(crate) fn publish(&self, state: &WallState) {
        self.hub.publish(state);
    }

    /// Whether anybody looks at live pictures.
    pub(crate) fn is_watched(&self) -> bool {
        self.hub.is_watched()
    }

    /// Shows remotes a picture.
    pub(crate) fn show(&self, picture: Thumbnail) {
        self.hub.show(picture);
    }
}

/// The address at which phones reach a listener on all addresses of this machine.
fn reachable(local: SocketAddr, own_address: Option<IpAddr>, host_name: &str) -> String {
    let ip = if local.ip().is_unspecified() { own_address } else { Some(local.ip()) };
    match ip {
        Some(IpAddr::V6(ip)) => format!("[{ip}]"),
        Some(ip) => ip.to_string(),
        None => host_name.to_owned(),
    }
}

/// The page's address on a host, or on one that has another name.
fn place(host: &str, name: Option<&str>, port: u16, is_encrypted: bool) -> String {
    match (name, is_encrypted) {
        (_, true) => format!("https://{}:{port}/", name.unwrap_or(host)),
        // The name is that of a proxy, which encrypts and has its own port.
        (Some(name), false) => format!("https://{name}/"),
        (None, false) => format!("http://{host}:{port}/"),
    }
}

async fn listen(address: &str, has_tokens: bool) -> anyhow::Result<TcpListener> {
    let resolved = tokio::net::lookup_host(address).await.with_context(|| {
        format!("--remote {address} is no address or name of this machine: write it as HOST:PORT, as in 0.0.0.0:7180")
    })?;
    let addresses: Vec<_> = resolved.collect();
    if !has_tokens && !addresses.iter().all(|address| address.ip().to_canonical().is_loopback()) {
        bail!(
            "--remote {address} is open to the network: make a token with `compositor remote-token remote.toml NAME`, and \
             add --remote-tokens remote.toml"
        );
    }
    TcpListener::bind(&addresses[..]).await.with_context(|| {
        format!("--remote cannot listen on {address}: choose another port, or an address of this machine")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_link_is_one_that_a_phone_can_open() {
        let own = Some([192, 168, 1, 7].into());
        let host = |address: &str| reachable(address.parse().unwrap(), own, "wall");
        assert_eq!(["0.0.0.0:7180", "10.0.0.1:80", "[::1]:80"].map(host), ["192.168.1.7", "10.0.0.1", "[::1]"]);
        assert_eq!(reachable("0.0.0.0:1".parse().unwrap(), None, "wall"), "wall");
        let place = |is_encrypted, name| place("10.0.0.1", name, 7180, is_encrypted);
        let places =
            [place(false, None), place(false, Some("wall.example")), place(true, None), place(true, Some("wall"))];
        assert_eq!(
            places,
            ["http://10.0.0.1:7180/", "https://wall.example/", "https://10.0.0.1:7180/", "https://wall:7180/"]
        );
    }

    #[test]
    fn nobody_serves_the_network_without_tokens() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let fault = |address: &str| format!("{:#}", runtime.block_on(listen(address, false)).unwrap_err());
        assert!(fault("0.0.0.0:0").contains("--remote-tokens remote.toml"));
        assert!(fault("nowhere").contains("HOST:PORT"));
        assert!(runtime.block_on(listen("127.0.0.1:0", false)).is_ok());
        assert!(runtime.block_on(listen("0.0.0.0:0", true)).is_ok());
    }
}
