use std::sync::Mutex;

use tokio::io::{DuplexStream, ReadHalf, WriteHalf, duplex, split};

use super::*;

type Half = (RecordReader<ReadHalf<DuplexStream>>, RecordWriter<WriteHalf<DuplexStream>>);

fn key(seed: u8) -> Key {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("key");
    std::fs::write(&path, format!("{seed:02x}").repeat(32)).unwrap();
    #[cfg(unix)]
    std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o600)).unwrap();
    Key::read(&path).unwrap()
}

/// Both ends of a channel.
async fn channel_between(server_end: DuplexStream, wall_end: DuplexStream) -> (Half, Half) {
    let key = key(1);
    let (server_in, server_out) = split(server_end);
    let (wall_in, wall_out) = split(wall_end);
    let (server, wall) = tokio::join!(connect(server_in, server_out, &key), accept(wall_in, wall_out, &key));
    (server.unwrap(), wall.unwrap())
}

/// A finished handshake, and each side's wire in the hands of an attacker.
async fn intercepted() -> ((Half, DuplexStream), (Half, DuplexStream)) {
    let (server_end, mut server_wire) = duplex(1 << 20);
    let (wall_end, mut wall_wire) = duplex(1 << 20);
    let passing_on = async {
        forward(&mut server_wire, &mut wall_wire, 8 + HANDSHAKE_BYTES).await;
        forward(&mut wall_wire, &mut server_wire, 8 + HANDSHAKE_BYTES).await;
        forward(&mut server_wire, &mut wall_wire, TAG_BYTES).await;
    };
    let ((server, wall), ()) = tokio::join!(channel_between(server_end, wall_end), passing_on);
    ((server, server_wire), (wall, wall_wire))
}

async fn forward(from: &mut DuplexStream, to: &mut DuplexStream, n_bytes: usize) -> Vec<u8> {
    let mut bytes = vec![0; n_bytes];
    from.read_exact(&mut bytes).await.unwrap();
    to.write_all(&bytes).await.unwrap();
    bytes
}

/// Writes `text` as one record, and takes the record off the wire.
async fn record(side: &mut Half, wire: &mut DuplexStream, text: &[u8]) -> Vec<u8> {
    side.1.write_all(text).await.unwrap();
    side.1.flush().await.unwrap();
    let mut record = vec![0; 2 + text.len() + TAG_BYTES];
    wire.read_exact(&mut record).await.unwrap();
    record
}

async fn heard(side: &mut Half, n_bytes: usize) -> io::Result<Vec<u8>> {
    let mut bytes = vec![0; n_bytes];
    side.0.read_exact(&mut bytes).await?;
    Ok(bytes)
}

fn noise_bytes(n_bytes: usize, mut state: u32) -> Vec<u8> {
    std::iter::repeat_with(|| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    })
    .take(n_bytes)
    .collect()
}

#[tokio::test]
async fn both_directions_carry_every_byte_at_the_same_time() {
    // Small pipes, which hold a handshake message, cut records everywhere; large ones hold several records.
    for pipe_bytes in [61, 1000, 1 << 20] {
        let (server_end, wall_end) = duplex(pipe_bytes);
        let (server, wall) = channel_between(server_end, wall_end).await;
        let n_bytes = if pipe_bytes < 100 { 50_000 } else { 3_000_000 };
        let talk = |mut half: Half, seed: u32| async move {
            let said = noise_bytes(n_bytes, seed);
            let speaking = async {
                let mut rest = &said[..];
                for size in [1, 17, RECORD_BYTES - 1, RECORD_BYTES, RECORD_BYTES + 1, 200_000].into_iter().cycle() {
                    let (now, later) = rest.split_at(size.min(rest.len()));
                    half.1.write_all(now).await.unwrap();
                    if size % 2 == 1 {
                        half.1.flush().await.unwrap();
                    }
                    rest = later;
                    if rest.is_empty() {
                        break;
                    }
                }
                half.1.shutdown().await.unwrap();
            };
            let listening = async {
                let mut heard = Vec::new();
                half.0.read_to_end(&mut heard).await.unwrap();
                heard
            };
            tokio::join!(speaking, listening).1
        };
        let (by_server, by_wall) = tokio::join!(talk(server, 1), talk(wall, 2));
        assert!(by_server == noise_bytes(n_bytes, 2) && by_wall == noise_bytes(n_bytes, 1), "{pipe_bytes}");
    }
}

#[tokio::test]
async fn no_plain_text_is_on_the_wire() {
    let ((mut server, mut server_wire), (mut wall, mut wall_wire)) = intercepted().await;
    let text = b"the model of the customer";
    for _ in 0..2 {
        let sealed = record(&mut server, &mut server_wire, text).await;
        assert!(!sealed.windows(4).any(|bytes| text.windows(4).any(|of_text| of_text == bytes)));
        wall_wire.write_all(&sealed).await.unwrap();
        assert_eq!(heard(&mut wall, text.len()).await.unwrap(), text);
    }
    let (first, second) =
        (record(&mut server, &mut server_wire, text).await, record(&mut server, &mut server_wire, text).await);
    assert_ne!(first, second, "the same text twice gives different bytes");
}

#[derive(Clone, Copy, Debug)]
enum Attack {
    Repeat,
    Swap,
    Omit,
    Reflect,
    Flip(usize),
    CutAndJoin,
}

#[tokio::test]
async fn a_record_that_is_not_in_its_place_ends_the_channel() {
    use Attack::{CutAndJoin, Flip, Omit, Reflect, Repeat, Swap};
    let flips = (0..2 + 6 + TAG_BYTES).map(Flip);
    for attack in [Repeat, Swap, Omit, Reflect, CutAndJoin].into_iter().chain(flips) {
        let ((mut server, mut server_wire), (mut wall, mut wall_wire)) = intercepted().await;
        let first = record(&mut server, &mut server_wire, b"first!").await;
        let second = record(&mut server, &mut server_wire, b"second").await;
        // The wall's second record, whose nonce the wall expects from the server.
        let _ = record(&mut wall, &mut wall_wire, b"answer").await;
        let by_wall = record(&mut wall, &mut wall_wire, b"answer").await;
        let (before, forged): (&[u8], Vec<u8>) = match attack {
            Repeat => (&first, first.clone()),
            Swap => (b"", [&second[..], &first].concat()),
            Omit => (b"", second.clone()),
            Reflect => (b"", by_wall),
            Flip(at) => {
                let mut flipped = first.clone();
                flipped[at] ^= 1;
                // More bytes follow, so that a changed length finds enough of them.
                (b"", [flipped, vec![0; 1000]].concat())
            }
            CutAndJoin => (b"", [&first[..first.len() - 3], &second].concat()),
        };
        wall_wire.write_all(before).await.unwrap();
        if !before.is_empty() {
            assert_eq!(heard(&mut wall, 6).await.unwrap(), b"first!");
        }
        wall_wire.write_all(&forged).await.unwrap();
        wall_wire.shutdown().await.unwrap();
        let error = heard(&mut wall, 1).await.unwrap_err();
        let is_clear = error.to_string().contains("changed, repeated, swapped or forged");
        assert!(is_clear, "{attack:?}: {error}");
        assert!(heard(&mut wall, 1).await.is_err(), "{attack:?}: the channel stays closed");
    }
}

#[tokio::test]
async fn a_channel_that_is_cut_in_a_record_is_an_error_and_between_two_an_end() {
    for n_bytes in 0..=2 + 6 + TAG_BYTES {
        let ((mut server, mut server_wire), (mut wall, mut wall_wire)) = intercepted().await;
        let whole = record(&mut server, &mut server_wire, b"first!").await;
        wall_wire.write_all(&whole[..n_bytes]).await.unwrap();
        wall_wire.shutdown().await.unwrap();
        let mut all = Vec::new();
        let ended = wall.0.read_to_end(&mut all).await;
        match n_bytes {
            0 => assert!(ended.is_ok() && all.is_empty()),
            n_bytes if n_bytes == whole.len() => assert!(ended.is_ok() && all == b"first!"),
            _ => assert_eq!(ended.unwrap_err().kind(), io::ErrorKind::UnexpectedEof, "{n_bytes}"),
        }
    }
}

/// The error of an acceptor that gets these bytes, and the number of bytes that it reads.
async fn accepting(bytes: &[u8], key: &Key) -> (SecureError, usize) {
    let (near, far) = duplex(1 << 20);
    let (input, output) = split(near);
    let (far_in, mut far_out) = split(far);
    far_out.write_all(bytes).await.unwrap();
    far_out.shutdown().await.unwrap();
    let taken = Arc::new(Mutex::new(0));
    let error = accept(Counting { input, taken: Arc::clone(&taken) }, output, key).await.unwrap_err();
    drop(far_in);
    let taken = *taken.lock().unwrap();
    (error, taken)
}

/// Counts the bytes read.
struct Counting<R> {
    input: R,
    taken: Arc<Mutex<usize>>,
}

impl<R: AsyncRead + Unpin> AsyncRead for Counting<R> {
    fn poll_read(
        mut self: std::pin::Pin<&mut Self>,
        context: &mut std::task::Context<'_>,
        buffer: &mut tokio::io::ReadBuf<'_>,
    ) -> std::task::Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let polled = std::pin::Pin::new(&mut self.input).poll_read(context, buffer);
        *self.taken.lock().unwrap() += buffer.filled().len() - before;
        polled
    }
}

#[tokio::test]
async fn strangers_are_told_apart_within_72_bytes() {
    let long = noise_bytes(1 << 19, 3);
    let with = |start: &[u8]| [start, &long].concat();
    let check = async |start: &[u8], expect: fn(&SecureError) -> bool, n_bytes: usize| {
        let (error, taken) = accepting(&with(start), &key(1)).await;
        assert!(expect(&error), "{error:?}");
        assert!(taken <= n_bytes, "{taken} bytes taken");
    };
    check(b"", |error| matches!(error, SecureError::NotRaywall), 1).await;
    check(b"GET / HTTP/1.1\r\n\r\n", |error| matches!(error, SecureError::NotRaywall), 1).await;
    check(&PREAMBLE, |error| matches!(error, SecureError::NoKey), 4).await;
    check(b"RAYLOCK\x63", |error| matches!(error, SecureError::OtherVersion(0x63)), 8).await;
    check(&SECURE_PREAMBLE, |error| matches!(error, SecureError::OtherKey), 56).await;
    // Points of low order instead of a key: refused like any other.
    check(&[&SECURE_PREAMBLE[..], &[0; 32]].concat(), |error| matches!(error, SecureError::OtherKey), 56).await;
    for n_bytes in 0..56 {
        let cut = [&SECURE_PREAMBLE[..], &[7; HANDSHAKE_BYTES]].concat();
        let (error, _) = accepting(&cut[..n_bytes], &key(1)).await;
        assert!(matches!(error, SecureError::Closed), "{n_bytes}: {error:?}");
    }
}

#[tokio::test]
async fn another_key_is_refused_on_both_sides_with_the_cure() {
    let (server_end, wall_end) = duplex(1 << 10);
    let (server_key, wall_key) = (key(1), key(2));
    let server = async {
        let (input, output) = split(server_end);
        connect(input, output, &server_key).await.unwrap_err()
    };
    let wall = async {
        let (input, output) = split(wall_end);
        accept(input, output, &wall_key).await.unwrap_err()
    };
    let (server, wall) = tokio::join!(server, wall);
    assert!(matches!(server, SecureError::Refused) && matches!(wall, SecureError::OtherKey), "{server:?} {wall:?}");
    for error in [server, wall] {
        assert!(error.to_string().contains("copies of one key file"), "{error}");
    }
}

#[tokio::test]
async fn a_recorded_conversation_gets_nowhere_on_either_side() {
    let (server_end, mut server_wire) = duplex(1 << 20);
    let (wall_end, mut wall_wire) = duplex(1 << 20);
    let passing_on = async {
        let mut by_server = forward(&mut server_wire, &mut wall_wire, 8 + HANDSHAKE_BYTES).await;
        let by_wall = forward(&mut wall_wire, &mut server_wire, 8 + HANDSHAKE_BYTES).await;
        by_server.extend(forward(&mut server_wire, &mut wall_wire, TAG_BYTES).await);
        (by_server, by_wall)
    };
    let ((mut server, _wall), (mut by_server, by_wall)) =
        tokio::join!(channel_between(server_end, wall_end), passing_on);
    by_server.extend(record(&mut server, &mut server_wire, b"samples of another frame").await);

    // Replay the server's bytes to the wall: they get one answer, and the wall reads no further.
    let (error, taken) = accepting(&by_server, &key(1)).await;
    assert!(matches!(error, SecureError::Replayed), "{error:?}");
    assert_eq!(taken, 8 + HANDSHAKE_BYTES + TAG_BYTES);

    // Replay the wall's bytes to the server, then reflect the server's own.
    let (near, mut far) = duplex(1 << 10);
    far.write_all(&by_wall).await.unwrap();
    let (input, output) = split(near);
    assert!(matches!(connect(input, output, &key(1)).await.unwrap_err(), SecureError::OtherKey));
    let (near, mut mirror) = duplex(1 << 10);
    let (input, output) = split(near);
    let key = key(1);
    let reflecting = async {
        let mut said = [0; 8 + HANDSHAKE_BYTES];
        mirror.read_exact(&mut said).await.unwrap();
        mirror.write_all(&said).await.unwrap();
    };
    let (refused, ()) = tokio::join!(connect(input, output, &key), reflecting);
    assert!(matches!(refused.unwrap_err(), SecureError::OtherKey));
}

#[test]
fn a_handshake_costs_a_few_kilobytes() {
    // Its heap holds four more ciphers, hashes and curve points of less than 1 KB each.
    assert!(size_of::<HandshakeState>() < 4096, "{}", size_of::<HandshakeState>());
}
