//! Gives the wall's scene file to one render server, on a connection that does nothing else.

use std::{sync::Arc, time::Duration};

use channel::wire::{Incoming, MessageReader, MessageWriter, WireError};
use shared::{
    codec,
    protocol::{CHUNK_BYTES, FETCH_BYTES, FETCH_SILENCE_LIMIT, ToServer, ToWall},
    scene::SceneId,
};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    sync::{Semaphore, watch},
    time::timeout,
};

use super::{
    connection::ConnectionError,
    supply::{Offer, SceneSupply, Supply},
};

/// Most transfers at a time. Each takes two megabytes of the wall's memory at most; others ask again.
const MOST_TRANSFERS: usize = 64;

/// How often a render server that waits for the file hears from the wall.
const AWAIT_INTERVAL: Duration = Duration::from_secs(1);

static TRANSFERS: Semaphore = Semaphore::const_new(MOST_TRANSFERS);

/// Gives the file of `scene` if that is on show or comes next, until the render server has what it wants.
pub(super) async fn serve(
    reader: &mut MessageReader<impl AsyncRead + Unpin, ToWall>,
    writer: &mut MessageWriter<impl AsyncWrite + Unpin>,
    supply: &Arc<SceneSupply>,
    scene: SceneId,
) -> Result<(), ConnectionError> {
    let Ok(_permit) = TRANSFERS.try_acquire() else {
        return refuse(writer, format!("{MOST_TRANSFERS} render servers fetch it already: wait until some have it"))
            .await;
    };
    let mut states = supply.ask(scene);
    let file = loop {
        let state = Offer::find(&states.borrow_and_update(), scene).map(|offer| offer.supply.clone());
        match state {
            None => return refuse(writer, OTHER_SCENE.to_owned()).await,
            Some(Supply::Ready(file)) => break file,
            Some(Supply::Failed(reason, _)) => return refuse(writer, reason).await,
            Some(Supply::Making(progress)) => send(writer, &ToServer::SceneFileAwaited { progress }).await?,
            Some(Supply::Unasked) => send(writer, &ToServer::SceneFileAwaited { progress: 0.0 }).await?,
        }
        wait_for_change(&mut states).await;
    };
    send(writer, &ToServer::SceneFile { n_bytes: file.n_bytes, hash: file.hash }).await?;
    let mut buffer = Vec::new();
    while let Some(incoming) = reader.read().await? {
        let Incoming::Control(ToWall::FetchPart { first, n_bytes }) = incoming else {
            return Err(ConnectionError::OutOfTurn);
        };
        let end = first.checked_add(u64::from(n_bytes)).filter(|end| *end <= file.n_bytes);
        if end.is_none() || !(1..=FETCH_BYTES as u32).contains(&n_bytes) {
            return Err(ConnectionError::OutOfTurn);
        }
        if !supply.offers(scene) {
            return refuse(writer, OTHER_SCENE.to_owned()).await;
        }
        // A disk may be slow: the network's threads must not wait for it.
        let (mut bytes, source) = (std::mem::take(&mut buffer), Arc::clone(&file));
        let reading = tokio::task::spawn_blocking(move || {
            bytes.resize(n_bytes as usize, 0);
            source.read_at(first, &mut bytes).map(|()| bytes)
        });
        let bytes = match reading.await {
            Ok(Ok(bytes)) => bytes,
            Ok(Err(fault)) => {
                supply.forget(scene);
                return refuse(writer, format!("its scene file is made or read again, because {fault}")).await;
            }
            // The wall ends.
            Err(_) => return Ok(()),
        };
        let mut message = Vec::with_capacity(codec::HEADER_BYTES + CHUNK_BYTES);
        for part in bytes.chunks(CHUNK_BYTES) {
            supply.pace().await;
            message.clear();
            codec::encode_file_part(part, &mut message);
            let written = timeout(FETCH_SILENCE_LIMIT, writer.write_encoded(&message)).await;
            written.map_err(|_| ConnectionError::Clogged)?.map_err(WireError::from)?;
        }
        flush(writer).await?;
        buffer = bytes;
    }
    Ok(())
}

const OTHER_SCENE: &str = "it shows another model";

async fn wait_for_change(states: &mut watch::Receiver<Vec<Offer>>) {
    // An interval without a change is told as life, and a wall that ends closes the connection.
    let _ = timeout(AWAIT_INTERVAL, states.changed()).await;
}

async fn refuse(writer: &mut MessageWriter<impl AsyncWrite + Unpin>, reason: String) -> Result<(), ConnectionError> {
    send(writer, &ToServer::Refused { reason }).await
}

async fn send(writer: &mut MessageWriter<impl AsyncWrite + Unpin>, message: &ToServer) -> Result<(), ConnectionError> {
    writer.push(message).map_err(WireError::from)?;
    flush(writer).await
}

async fn flush(writer: &mut MessageWriter<impl AsyncWrite + Unpin>) -> Result<(), ConnectionError> {
    let flushed = timeout(FETCH_SILENCE_LIMIT, writer.flush()).await.map_err(|_| ConnectionError::Clogged)?;
    flushed.map_err(WireError::from)?;
    Ok(())
}
