//! Render servers that break the protocol's rules: each loses its connection with one clear line, and no frame a sample.

use std::{
    io::{Read, Write},
    net::TcpStream,
    thread,
};

use shared::{
    codec::{self, HEADER_BYTES},
    division::{FrameSize, Task},
    protocol::{Chunk, Encoding, FrameId, PREAMBLE, RunCosts, SceneState, TaskId, TaskTimings, ToServer, ToWall},
};

use crate::farm::RunningWall;

/// A task from the wall.
pub(crate) struct GivenTask {
    frame: FrameId,
    task_id: TaskId,
    task: Task,
    size: FrameSize,
}

impl GivenTask {
    /// The right answer, from the frame's samples: one chunk for each 64 units.
    pub(crate) fn chunks(&self, rgb: &[u8]) -> Vec<Vec<u8>> {
        let share = self.task.share(self.size).unwrap();
        let sample = |(i, j): (u32, u32)| {
            let at = 3 * (j * self.size.xres() + i) as usize;
            [rgb[at], rgb[at + 1], rgb[at + 2]]
        };
        let units = (0..share.count()).step_by(64).map(|first| first..(first + 64).min(share.count()));
        units
            .map(|units| {
                let samples: Vec<u8> = units.clone().flat_map(|k| share.samples(k).iter()).flat_map(sample).collect();
                self.chunk(units.start, units.len() as u32, &samples)
            })
            .collect()
    }

    fn chunk(&self, first_unit: u32, n_units: u32, rgb: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let chunk = Chunk { frame: self.frame, task_id: self.task_id, first_unit, n_units, rgb };
        chunk.encode(Encoding::Raw, &mut bytes);
        bytes
    }

    pub(crate) fn done(&self) -> Vec<u8> {
        let (timings, costs) = (TaskTimings::default(), RunCosts::default());
        message(&ToWall::TaskDone { frame: self.frame, task_id: self.task_id, timings, costs })
    }
}

pub(crate) fn message(message: &ToWall) -> Vec<u8> {
    let mut bytes = Vec::new();
    codec::encode(message, &mut bytes).unwrap();
    bytes
}

/// Joins a wall: says hello and waits for the welcome.
pub(crate) fn shake_hands(stream: &mut TcpStream, name: &str) -> std::io::Result<()> {
    stream.write_all(&PREAMBLE)?;
    stream.write_all(&message(&ToWall::Hello { name: name.to_owned(), threads: 1 }))?;
    stream.read_exact(&mut [0; PREAMBLE.len()])?;
    receive(stream).map(|welcome| assert_eq!(welcome, ToServer::Welcome))
}

/// Reads one message.
pub(crate) fn receive(stream: &mut TcpStream) -> std::io::Result<ToServer> {
    let mut header = [0; HEADER_BYTES];
    stream.read_exact(&mut header)?;
    let mut body = vec![0; u32::from_le_bytes([header[0], header[1], header[2], header[3]]) as usize];
    stream.read_exact(&mut body)?;
    Ok(codec::decode(&body).unwrap())
}

/// Joins a wall and answers each task with the bytes that `answer` makes, until the wall drops the connection.
pub(crate) fn lie(
    stream: &mut TcpStream,
    name: &str,
    answer: impl FnMut(&GivenTask) -> Vec<u8>,
) -> std::io::Result<()> {
    shake_hands(stream, name)?;
    answer_tasks(stream, answer)
}

/// The rest of [`lie`], once the node has joined.
pub(crate) fn answer_tasks(
    stream: &mut TcpStream,
    mut answer: impl FnMut(&GivenTask) -> Vec<u8>,
) -> std::io::Result<()> {
    loop {
        match receive(stream)? {
            ToServer::LoadScene { scene, .. } => {
                let state = SceneState::Ready { triangles: 1, bytes: 1, grid: None };
                stream.write_all(&message(&ToWall::SceneState { scene, state }))?;
            }
            ToServer::RenderFrame { frame, task_id, spec, task, .. } => {
                stream.write_all(&answer(&GivenTask { frame, task_id, task, size: spec.size }))?;
            }
            ToServer::Ping { sent_us } => stream.write_all(&message(&ToWall::Pong { sent_us }))?,
            _ => {}
        }
    }
}

#[test]
fn a_renderer_that_breaks_the_rules_is_dropped_and_costs_no_sample() {
    type Lie = fn(&GivenTask) -> Vec<u8>;
    let lies: [(&str, Lie, &str); 8] = [
        ("short", |asked| asked.chunk(0, 1, &[0; 2]), "sent samples that do not fit their task"),
        ("long", |asked| asked.chunk(0, 1, &[0; 65_000]), "sent samples that do not fit their task"),
        ("beyond", |asked| asked.chunk(u32::MAX, 2, &[0; 384]), "sent samples that do not fit their task"),
        ("idle", GivenTask::done, "reported a task as done after 0 of"),
        (
            "repeating",
            |asked| [asked.chunk(0, 1, &[0; 192]), asked.chunk(0, 1, &[0; 192]), asked.done()].concat(),
            "reported a task as done after 1 of",
        ),
        (
            "packed",
            |asked| {
                // An LZ4 block that announces bytes which it lacks.
                let mut bytes = asked.chunk(0, 1, &[0xff; 192]);
                bytes[HEADER_BYTES - 1] = 2;
                bytes
            },
            "samples that do not unpack",
        ),
        ("huge", |_| vec![0xff, 0xff, 0xff, 0xff, 1], "a message of 4294967295 bytes"),
        ("talking", |_| message(&ToWall::Hello { name: "again".into(), threads: 1 }), "it spoke out of turn"),
    ];
    let mut wall = RunningWall::start_with(&["--division", "tiled"]);
    let _honest = wall.join("honest");
    wall.wait_for_frames(2);
    for (name, answer, reason) in lies {
        let mut stream = wall.connect();
        let liar = thread::spawn(move || lie(&mut stream, name, answer));
        wall.program.wait_for(&format!("render server {name} at "));
        // The liar fails at its next read or write.
        let _ = liar.join().unwrap();
        let said = wall.program.said();
        let line = said.lines().find(|line| line.contains(&format!("render server {name} at "))).unwrap();
        assert!(line.contains(reason), "{line}");
    }
    // A connection that ends in the middle of a chunk.
    let mut stream = wall.connect();
    let closing = stream.try_clone().unwrap();
    let cut = thread::spawn(move || {
        let mut is_sent = false;
        lie(&mut stream, "cut", |asked| {
            if std::mem::replace(&mut is_sent, true) {
                return Vec::new();
            }
            let mut bytes = asked.chunk(0, 1, &[0; 192]);
            bytes.truncate(100);
            // Close the connection after the bytes have been sent.
            let closing = closing.try_clone().unwrap();
            thread::spawn(move || {
                thread::sleep(std::time::Duration::from_millis(50));
                closing.shutdown(std::net::Shutdown::Both)
            });
            bytes
        })
    });
    wall.program.wait_for("closed in mid-message");
    let _ = cut.join().unwrap();
    wall.wait_for_frames(3);
    wall.end();
}

#[test]
fn old_and_repeated_answers_change_nothing() {
    let mut wall = RunningWall::start_with(&["--division", "tiled"]);
    let rgb = wall.expected_samples();
    let _honest = wall.join("honest");
    wall.wait_for_frames(2);
    let mut stream = wall.connect();
    let mut last: Option<GivenTask> = None;
    let mut n_tasks = 0;
    thread::spawn(move || {
        lie(&mut stream, "confused", |asked| {
            n_tasks += 1;
            let mut bytes = asked.chunks(&rgb).concat();
            // Answer the last frame's task again, with wrong samples, before and after this one, and this one twice.
            if let Some(last) = &last {
                bytes = [last.chunk(0, 1, &[n_tasks as u8; 192]), bytes, last.done()].concat();
            }
            bytes.extend(asked.chunks(&rgb).concat());
            bytes.extend(asked.done());
            bytes.extend(asked.chunk(0, 1, &[n_tasks as u8; 192]));
            bytes.extend(asked.done());
            let GivenTask { frame, task_id, size, .. } = *asked;
            last = Some(GivenTask { frame, task_id, task: asked.task, size });
            bytes
        })
    });
    wall.program.wait_for("render server confused is ready");
    wall.wait_for_frames(20);
    let (frames, said) = wall.end();
    assert!(!said.contains("render server confused at"), "the render server is lost\n{said}");
    assert_eq!(crate::farm::nodes_of(frames.last().unwrap()), ["honest", "confused"]);
}
