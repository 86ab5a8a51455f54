//! Drops a file on a window as a file manager does: the source's side of XDND, version 5.

use std::{path::Path, time::Instant};

use x11rb::{
    COPY_DEPTH_FROM_PARENT, COPY_FROM_PARENT,
    connection::Connection,
    protocol::{
        Event,
        xproto::{
            Atom, ClientMessageEvent, ConnectionExt, CreateWindowAux, EventMask, PropMode, SELECTION_NOTIFY_EVENT,
            SelectionNotifyEvent, WindowClass,
        },
    },
    wrapper::ConnectionExt as _,
};

use crate::process::GENEROUS;

/// Drops a file on the middle of a window, given by its number; returns when the window has taken it.
pub(crate) fn drop_file(display: &str, window: &str, path: &Path) {
    let target: u32 = window.parse().expect("a window's number");
    let (connection, screen) = x11rb::connect(Some(display)).expect("the X server runs");
    let root = connection.setup().roots[screen].root;
    let source = connection.generate_id().expect("a free number");
    let none = CreateWindowAux::new();
    let (depth, class) = (COPY_DEPTH_FROM_PARENT, WindowClass::INPUT_OUTPUT);
    connection.create_window(depth, source, root, 0, 0, 1, 1, 0, class, COPY_FROM_PARENT, &none).expect("sent");
    let atom = |name: &str| -> Atom {
        connection.intern_atom(false, name.as_bytes()).expect("sent").reply().expect("an atom").atom
    };
    let send = |name: &str, data: [u32; 5]| {
        let message = ClientMessageEvent::new(32, target, atom(name), data);
        connection.send_event(false, target, EventMask::NO_EVENT, message).expect("sent");
        connection.flush().expect("sent");
    };
    let (uri_list, copy) = (atom("text/uri-list"), atom("XdndActionCopy"));
    let (status, finished) = (atom("XdndStatus"), atom("XdndFinished"));
    connection.set_selection_owner(source, atom("XdndSelection"), x11rb::CURRENT_TIME).expect("sent");

    let geometry = connection.get_geometry(target).expect("sent").reply().expect("the window is there");
    let middle = (i32::from(geometry.width) / 2, i32::from(geometry.height) / 2);
    let on_root = connection.translate_coordinates(target, root, middle.0 as i16, middle.1 as i16).expect("sent");
    let on_root = on_root.reply().expect("the window is there");
    let position = (on_root.dst_x as u32) << 16 | on_root.dst_y as u32;
    send("XdndEnter", [source, 5 << 24, uri_list, 0, 0]);
    send("XdndPosition", [source, 0, position, x11rb::CURRENT_TIME, copy]);

    let uris = format!("file://{}\r\n", path.to_str().expect("plain names in tests").replace(' ', "%20"));
    let start = Instant::now();
    loop {
        assert!(start.elapsed() < GENEROUS, "the window does not take the file");
        match connection.poll_for_event().expect("the X server runs") {
            Some(Event::SelectionRequest(request)) => {
                let (requestor, property) = (request.requestor, request.property);
                connection
                    .change_property8(PropMode::REPLACE, requestor, property, uri_list, uris.as_bytes())
                    .expect("sent");
                let answer = SelectionNotifyEvent {
                    response_type: SELECTION_NOTIFY_EVENT,
                    sequence: 0,
                    time: request.time,
                    requestor,
                    selection: request.selection,
                    target: request.target,
                    property,
                };
                connection.send_event(false, requestor, EventMask::NO_EVENT, answer).expect("sent");
                connection.flush().expect("sent");
            }
            Some(Event::ClientMessage(message)) if message.type_ == status => {
                assert!(message.data.as_data32()[1] & 1 == 1, "the window refuses the file");
                send("XdndDrop", [source, 0, x11rb::CURRENT_TIME, 0, 0]);
            }
            Some(Event::ClientMessage(message)) if message.type_ == finished => return,
            Some(_) => {}
            None => std::thread::sleep(std::time::Duration::from_millis(5)),
        }
    }
}
