//! A conversation with one remote: its wishes, and the wall's answers.

use std::{
    net::IpAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use axum::{
    body::Bytes,
    extract::ws::{Message as Frame, Utf8Bytes, WebSocket},
};
use serde_json::json;
use tokio::sync::{mpsc, watch};

use super::{
    hub::{Connected, Hub, Order, Told, Watching},
    message::{self, Action},
    routes::Guest,
    tokens::Role,
    turns::{Client, Place},
};
use crate::farm::RateLimit;

/// Conversations at a time.
const MOST_REMOTES: usize = 512;
/// Places among them that visitors leave free, so that operators always get in.
const FOR_OPERATORS: usize = 64;
/// Messages, pings too, that a remote may send at once, and the pause between further ones: two hands at 120 Hz.
const MESSAGES: (u32, Duration) = (240, Duration::from_millis(4));
/// A remote that takes longer than this for one message has gone.
const LONGEST_SEND: Duration = Duration::from_secs(5);
/// The pause between two live pictures.
const PICTURE_INTERVAL: Duration = Duration::from_millis(250);
/// Answers that wait for a remote.
const MOST_ANSWERS: usize = 32;

/// A place for one more remote of a network, unless there are too many. A network's visitors take at most as many places as
/// they leave, so one that wants all keeps nobody else out.
pub(super) fn admit(hub: &Arc<Hub>, role: Role, network: IpAddr) -> Option<Connected> {
    hub.remote(network, |n_remotes, of_network| match role {
        Role::Visitor => n_remotes + of_network < MOST_REMOTES - FOR_OPERATORS,
        Role::Operator => n_remotes < MOST_REMOTES,
    })
}

/// Talks until the remote goes away, is too slow, or its token is revoked.
pub(super) async fn converse(socket: WebSocket, hub: Arc<Hub>, guest: Guest, remote: Connected) {
    let client = hub.new_client(remote.network);
    let (answers, shown) = mpsc::channel(MOST_ANSWERS);
    let mut conversation = Conversation {
        socket,
        guest,
        client,
        answers,
        shown,
        told: hub.told(),
        turned: hub.turned(),
        pictures: hub.pictures(),
        pictured_at: None,
        watching: None,
        place: None,
        limit: RateLimit::new(MESSAGES.0, MESSAGES.1),
        started_at: Instant::now(),
        hub: Arc::clone(&hub),
    };
    conversation.told.mark_changed();
    // Its end is no event: remotes come and go.
    let _gone = conversation.go_on().await;
    hub.leave(client);
    drop(remote);
}

/// The remote has gone, or must go.
struct Gone;

struct Conversation {
    socket: WebSocket,
    hub: Arc<Hub>,
    guest: Guest,
    client: Client,
    answers: mpsc::Sender<u32>,
    shown: mpsc::Receiver<u32>,
    told: watch::Receiver<Told>,
    turned: watch::Receiver<()>,
    pictures: watch::Receiver<Bytes>,
    /// When the last picture was sent.
    pictured_at: Option<Instant>,
    /// Present while the remote looks at live pictures.
    watching: Option<Watching>,
    /// The place in the order of turns that the remote knows of.
    place: Option<Place>,
    limit: RateLimit,
    started_at: Instant,
}

impl Conversation {
    async fn go_on(&mut self) -> Result<(), Gone> {
        self.tell_place().await?;
        loop {
            let is_watching = self.watching.is_some();
            let next_picture_at = self.pictured_at.map(|at| at + PICTURE_INTERVAL);
            let pictures = &mut self.pictures;
            let new_picture = async {
                if !is_watching {
                    return std::future::pending().await;
                }
                if let Some(at) = next_picture_at {
                    tokio::time::sleep_until(at.into()).await;
                }
                pictures.changed().await
            };
            tokio::select! {
                received = self.socket.recv() => self.hear(received.ok_or(Gone)?.map_err(|_| Gone)?).await?,
                Some(tag) = self.shown.recv() => self.say(json!({ "shown": tag })).await?,
                changed = self.told.changed() => {
                    changed.map_err(|_| Gone)?;
                    self.check_token()?;
                    let text = self.told.borrow_and_update().to(self.guest.role).clone();
                    self.send(Frame::Text(text)).await?;
                }
                changed = self.turned.changed() => {
                    changed.map_err(|_| Gone)?;
                    self.turned.borrow_and_update();
                    self.tell_place().await?;
                }
                changed = new_picture => {
                    changed.map_err(|_| Gone)?;
                    let jpeg = self.pictures.borrow_and_update().clone();
                    self.pictured_at = Some(Instant::now());
                    self.send(Frame::Binary(jpeg)).await?;
                }
            }
        }
    }

    async fn hear(&mut self, frame: Frame) -> Result<(), Gone> {
        let now = self.started_at.elapsed();
        // The remote's messages wait in its own socket.
        tokio::time::sleep(self.limit.wait(now)).await;
        self.limit.count(self.started_at.elapsed());
        self.check_token()?;
        let text = match frame {
            Frame::Text(text) => text,
            Frame::Close(_) => return Err(Gone),
            // Takes the place of the library's answer, which would wait for the remote without end.
            Frame::Ping(payload) => return self.send(Frame::Pong(payload)).await,
            Frame::Pong(_) => return Ok(()),
            Frame::Binary(_) => return self.refuse("messages are JSON in text").await,
        };
        let message = match message::decode(text.as_bytes()) {
            Ok(message) => message,
            Err(problem) => return self.refuse(&problem).await,
        };
        match message.action {
            Action::Leave => self.hub.leave(self.client),
            Action::Watch { pictures } => {
                self.watching = pictures.then(|| self.hub.watching());
                // The wall may rest: its last picture is asked for.
                if pictures && let Err(problem) = self.hub.order(Order::Picture) {
                    return self.refuse(problem).await;
                }
            }
            _ => {
                if let Err(problem) = self.hub.act(self.guest.role, self.client, message, Some(&self.answers)) {
                    return self.refuse(problem).await;
                }
            }
        }
        Ok(())
    }

    /// A token may be revoked at any time.
    fn check_token(&self) -> Result<(), Gone> {
        let role = self.hub.access.role(self.guest.token.as_deref());
        if role == Some(self.guest.role) { Ok(()) } else { Err(Gone) }
    }

    /// Tells the remote its place, if that has changed.
    async fn tell_place(&mut self) -> Result<(), Gone> {
        let place = self.hub.place(self.client);
        if self.place.replace(place) == Some(place) {
            return Ok(());
        }
        self.say(json!({ "turn": place })).await
    }

    async fn refuse(&mut self, problem: &str) -> Result<(), Gone> {
        self.say(json!({ "refused": problem })).await
    }

    async fn say(&mut self, message: serde_json::Value) -> Result<(), Gone> {
        self.send(Frame::Text(Utf8Bytes::from(message.to_string()))).await
    }

    async fn send(&mut self, frame: Frame) -> Result<(), Gone> {
        match tokio::time::timeout(LONGEST_SEND, self.socket.send(frame)).await {
            Ok(Ok(())) => Ok(()),
            _ => Err(Gone),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::remote::access::Access;

    #[test]
    fn visitors_leave_places_to_operators() {
        let hub = Arc::new(Hub::new(Access::new(Vec::new(), None), mpsc::channel(1).0, Box::new(|| {})));
        let fill = |role, network: u8| {
            let network = [10, 0, 0, network].into();
            std::iter::from_fn(|| admit(&hub, role, network)).collect::<Vec<_>>()
        };
        let mut visitors: Vec<_> = (1..20).map(|network| fill(Role::Visitor, network)).collect();
        let counts: Vec<_> = visitors.iter().map(Vec::len).collect();
        assert_eq!(counts[..5], [224, 112, 56, 28, 14], "each leaves as many places as it takes");
        assert_eq!(counts.iter().sum::<usize>(), 448);
        let operators = fill(Role::Operator, 1);
        assert_eq!(operators.len(), 64);
        visitors[0].pop();
        assert!(fill(Role::Visitor, 2).is_empty() && fill(Role::Operator, 3).len() == 1);
    }
}
