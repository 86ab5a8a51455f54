//! Accepts connections, encrypts them if the wall has a certificate, and bounds them: in number, in size and in time.

use std::{collections::VecDeque, net::SocketAddr, sync::Arc, time::Duration};

use super::{certificate::CertificateFile, hub::Hub, routes};
use axum::Router;
use hyper::server::conn::http1;
use hyper_util::{rt::TokioIo, service::TowerToHyperService};
use socket2::{SockRef, TcpKeepalive};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::{TcpListener, TcpStream},
    task::AbortHandle,
};

/// Connections that have not become conversations; a new one displaces the oldest, so silent ones keep nobody out. Thousands
/// a second do: that is a firewall's task.
const MOST_STRANGERS: usize = 128;
/// A connection ends after this, unless it has become a conversation.
const LONGEST_REQUEST: Duration = Duration::from_secs(10);
/// The most bytes of a request's head.
const LONGEST_HEAD: usize = 16 << 10;
/// The system asks a silent peer after this whether it is still there; the wall itself does nothing meanwhile.
const KEEP_ALIVE: Duration = Duration::from_secs(30);

/// How an encrypted connection begins: with a TLS record of a handshake.
const HANDSHAKE: u8 = 22;

/// Serves remotes until it is dropped, and only encrypted ones if there is a certificate.
pub(super) async fn serve(listener: TcpListener, hub: Arc<Hub>, certificate: Option<Arc<CertificateFile>>) {
    let (router, plain) = (routes::router(Arc::clone(&hub)), routes::encrypted_only(Arc::clone(&hub)));
    let door = Door { router, plain, certificate };
    tokio::join!(accept(listener, door), hub.tell_states(), hub.encode_pictures(), hub.end_turns());
}

/// What connections come to.
#[derive(Clone)]
struct Door {
    router: Router,
    /// For those that are not encrypted but should be.
    plain: Router,
    certificate: Option<Arc<CertificateFile>>,
}

async fn accept(listener: TcpListener, door: Door) {
    let mut strangers: VecDeque<AbortHandle> = VecDeque::new();
    loop {
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                // As when all file descriptors are taken: they become free again.
                tracing::warn!("a remote cannot connect: {error}");
                tokio::time::sleep(Duration::from_secs(1)).await;
                continue;
            }
        };
        strangers.retain(|stranger| !stranger.is_finished());
        if strangers.len() >= MOST_STRANGERS
            && let Some(oldest) = strangers.pop_front()
        {
            oldest.abort();
        }
        strangers.push_back(tokio::spawn(receive(stream, peer, door.clone())).abort_handle());
    }
}

async fn receive(stream: TcpStream, peer: SocketAddr, Door { router, plain, certificate }: Door) {
    let socket = SockRef::from(&stream);
    // Without these the conversation works too.
    let _ = socket.set_tcp_nodelay(true);
    let _ = socket.set_tcp_keepalive(&TcpKeepalive::new().with_time(KEEP_ALIVE));
    let conversation = async {
        let Some(certificate) = certificate else { return converse(stream, peer, router).await };
        let mut first = [0];
        match stream.peek(&mut first).await {
            Ok(1) if first == [HANDSHAKE] => {
                if let Ok(stream) = certificate.renewed().acceptor.accept(stream).await {
                    converse(stream, peer, router).await;
                }
            }
            Ok(1) => converse(stream, peer, plain).await,
            _ => {}
        }
    };
    let _ = tokio::time::timeout(LONGEST_REQUEST, conversation).await;
}

/// Answers a request; malformed ones, and peers that go away, are everyday events.
async fn converse(stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static, peer: SocketAddr, router: Router) {
    let service = TowerToHyperService::new(router.layer(axum::Extension(routes::Peer(peer))));
    let connection = http1::Builder::new()
        .header_read_timeout(None)
        .max_buf_size(LONGEST_HEAD)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    let _ = connection.await;
}
