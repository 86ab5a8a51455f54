//! A proxy between a wall and its render servers, which may record, change or delay what they say.

use std::{
    io::{Read, Write},
    net::{Shutdown, TcpListener, TcpStream},
    sync::Arc,
    thread,
};

/// Which way bytes travel.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Direction {
    ToWall,
    ToServer,
}

/// Passes connections on to `wall`; returns the address to connect to.
///
/// `on_bytes` gets the connection's number, the direction, and at most `buffer_bytes` bytes, before they are passed on.
pub(crate) fn start(
    wall: &str,
    buffer_bytes: usize,
    on_bytes: impl Fn(usize, Direction, &mut [u8]) + Send + Sync + 'static,
) -> String {
    start_cutting(wall, buffer_bytes, move |number, direction, bytes| {
        on_bytes(number, direction, bytes);
        true
    })
}

/// Like [`start`]; bytes for which `on_bytes` returns false are the last of their connection.
pub(crate) fn start_cutting(
    wall: &str,
    buffer_bytes: usize,
    on_bytes: impl Fn(usize, Direction, &mut [u8]) -> bool + Send + Sync + 'static,
) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (wall, on_bytes) = (wall.to_owned(), Arc::new(on_bytes));
    thread::spawn(move || {
        for (number, server) in listener.incoming().map_while(Result::ok).enumerate() {
            // The wall has ended.
            let Ok(wall) = TcpStream::connect(&wall) else { return };
            let (to_server, from_wall) = (server.try_clone().unwrap(), wall.try_clone().unwrap());
            for (direction, from, to) in
                [(Direction::ToServer, from_wall, to_server), (Direction::ToWall, server, wall)]
            {
                let on_bytes = Arc::clone(&on_bytes);
                thread::spawn(move || pass_on(from, to, buffer_bytes, |bytes| on_bytes(number, direction, bytes)));
            }
        }
    });
    address
}

fn pass_on(mut from: TcpStream, mut to: TcpStream, buffer_bytes: usize, on_bytes: impl Fn(&mut [u8]) -> bool) {
    let mut bytes = vec![0; buffer_bytes];
    while let Ok(n_bytes @ 1..) = from.read(&mut bytes) {
        let goes_on = on_bytes(&mut bytes[..n_bytes]);
        if to.write_all(&bytes[..n_bytes]).is_err() || !goes_on {
            break;
        }
    }
    // The end of either stream ends the connection.
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}
