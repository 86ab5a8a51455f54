//! The routes: the page for everybody, everything else for those who may.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axum::{
    Extension, Json, Router,
    body::{Body, Bytes},
    extract::{
        DefaultBodyLimit, Request, State,
        rejection::BytesRejection,
        ws::{WebSocketUpgrade, rejection::WebSocketUpgradeRejection},
    },
    http::{HeaderMap, HeaderName, HeaderValue, StatusCode, Uri, header},
    middleware::{self, Next},
    response::{IntoResponse, Response},
    routing::{MethodRouter, get, post},
};
use serde_json::json;

use super::{
    access::is_same_origin,
    hub::{Hub, Order},
    message::{self, LONGEST_MESSAGE},
    socket,
    tokens::Role,
    turns::network,
};

/// The name of the WebSocket's protocol; a second one offered beside it is the token.
const PROTOCOL: &str = "raywall";
/// A picture that was asked for comes within this time, or there is none.
const LONGEST_WAIT_FOR_PICTURE: Duration = Duration::from_secs(3);

/// The most bytes that wait for a remote to take them: the longest state fits, and pictures are shorter.
const MOST_UNSENT: usize = 1 << 20;

/// The peer of a connection.
#[derive(Clone, Copy, Debug)]
pub(super) struct Peer(pub(super) SocketAddr);

/// The parts of the page, which hold no secret: the token in the page's address stays in the browser until the page sends it.
const PAGE: [(&str, &str, &str); 4] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/remote.js", "text/javascript; charset=utf-8", include_str!("page/remote.js")),
    ("/openapi.json", "application/json", include_str!("page/openapi.json")),
];

/// Everything from this wall, and nothing else.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; \
    connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The routes that need a token.
fn guarded() -> [(&'static str, MethodRouter<Arc<Hub>>); 6] {
    [
        ("/api/state", get(state)),
        ("/api/action", post(action)),
        ("/api/picture", get(picture)),
        ("/api/socket", get(open_socket)),
        ("/metrics", get(metrics)),
        ("/health", get(health)),
    ]
}

pub(super) fn router(hub: Arc<Hub>) -> Router {
    let mut router = Router::new();
    for (path, route) in guarded() {
        router = router.route(path, route);
    }
    router = router.layer(middleware::from_fn_with_state(Arc::clone(&hub), authorize));
    for (path, kind, text) in PAGE {
        router = router.route(path, get(move || async move { ([(header::CONTENT_TYPE, kind)], text) }));
    }
    let known = middleware::from_fn_with_state(Arc::clone(&hub), of_this_wall);
    router.fallback(nowhere).layer(DefaultBodyLimit::max(LONGEST_MESSAGE)).layer(known).with_state(hub)
}

/// Sends all who come without encryption to the same place with it.
pub(super) fn encrypted_only(hub: Arc<Hub>) -> Router {
    let known = middleware::from_fn_with_state(Arc::clone(&hub), of_this_wall);
    Router::new().fallback(encrypted_place).layer(known).with_state(hub)
}

async fn encrypted_place(headers: HeaderMap, uri: Uri) -> Response {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    let place = format!("https://{host}{}", uri.path_and_query().map_or("/", |path| path.as_str()));
    (StatusCode::PERMANENT_REDIRECT, [(header::LOCATION, place)]).into_response()
}

/// Refuses requests under other names and from pages of other origins, and adds headers to every answer.
async fn of_this_wall(State(hub): State<Arc<Hub>>, request: Request, next: Next) -> Response {
    let refused = refusal(&hub, request.headers());
    let mut response = match refused {
        Some((status, text)) => fault(status, text),
        None => next.run(request).await,
    };
    let is_conversation = response.status() == StatusCode::SWITCHING_PROTOCOLS;
    let headers = response.headers_mut();
    let mut set = |name: HeaderName, value: &'static str| headers.insert(name, HeaderValue::from_static(value));
    set(header::CONTENT_SECURITY_POLICY, POLICY);
    set(header::X_CONTENT_TYPE_OPTIONS, "nosniff");
    set(header::REFERRER_POLICY, "no-referrer");
    set(HeaderName::from_static("cross-origin-resource-policy"), "same-origin");
    set(header::CACHE_CONTROL, "no-store");
    if !is_conversation {
        set(header::CONNECTION, "close");
    }
    response
}

/// The reason to refuse a request before anything else is asked.
fn refusal(hub: &Hub, headers: &HeaderMap) -> Option<(StatusCode, &'static str)> {
    let text = |name: HeaderName| headers.get(name).map(|value| value.to_str().unwrap_or("?"));
    let host = text(header::HOST).unwrap_or_default();
    if !hub.access.knows_host(host) {
        return Some((StatusCode::MISDIRECTED_REQUEST, "the wall has another name: --remote-name NAME adds this one"));
    }
    let is_same = is_same_origin(host, text(header::ORIGIN));
    (!is_same).then_some((StatusCode::FORBIDDEN, "only the wall's own page may ask from a browser"))
}

/// Lets only those pass who have a token, or reach a wall that needs none.
async fn authorize(
    State(hub): State<Arc<Hub>>,
    Extension(Peer(peer)): Extension<Peer>,
    mut request: Request,
    next: Next,
) -> Response {
    let token = token(request.headers()).map(str::to_owned);
    match hub.access.role(token.as_deref()) {
        Some(role) => {
            request.extensions_mut().insert(Guest { role, token });
            next.run(request).await
        }
        None => {
            hub.on_stranger(peer.ip());
            let text = match token {
                Some(_) => "this token is not known or was revoked: scan the code on the wall, or ask an operator",
                None => "a token is needed: scan the code on the wall, or ask an operator",
            };
            fault(StatusCode::UNAUTHORIZED, text)
        }
    }
}

/// Somebody whom the wall lets in.
#[derive(Clone)]
pub(super) struct Guest {
    pub(super) role: Role,
    /// Its token, which may be revoked.
    pub(super) token: Option<String>,
}

/// The token of a request: `Authorization: Bearer`, or the second protocol that a WebSocket offers, since browsers let pages
/// set no other header of it.
fn token(headers: &HeaderMap) -> Option<&str> {
    let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
    let bearer = text(header::AUTHORIZATION).and_then(|value| value.strip_prefix("Bearer "));
    let offered = || text(header::SEC_WEBSOCKET_PROTOCOL)?.split(',').map(str::trim).find(|offer| *offer != PROTOCOL);
    bearer.or_else(offered)
}

fn fault(status: StatusCode, text: &str) -> Response {
    (status, Json(json!({ "error": text }))).into_response()
}

async fn nowhere() -> Response {
    fault(StatusCode::NOT_FOUND, "there is nothing here: /openapi.json lists what there is")
}

async fn state(State(hub): State<Arc<Hub>>, Extension(guest): Extension<Guest>) -> Response {
    let told = hub.told().borrow().to(guest.role).clone();
    ([(header::CONTENT_TYPE, "application/json")], told.as_str().to_owned()).into_response()
}

async fn action(
    State(hub): State<Arc<Hub>>,
    Extension(guest): Extension<Guest>,
    Extension(Peer(peer)): Extension<Peer>,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    if guest.role == Role::Visitor {
        return fault(StatusCode::FORBIDDEN, "visitors steer through /api/socket, in turns");
    }
    let body = match body {
        Ok(body) => body,
        Err(rejection) => return fault(rejection.status(), "an action is JSON of a few kilobytes"),
    };
    let message = match message::decode(&body) {
        Ok(message) => message,
        Err(problem) => return fault(StatusCode::BAD_REQUEST, &problem),
    };
    match hub.act(guest.role, hub.new_client(network(peer.ip())), message, None) {
        Ok(()) => StatusCode::NO_CONTENT.into_response(),
        Err(problem) => fault(StatusCode::SERVICE_UNAVAILABLE, problem),
    }
}

async fn picture(State(hub): State<Arc<Hub>>) -> Response {
    let mut pictures = hub.pictures();
    if let Err(problem) = hub.order(Order::Picture) {
        return fault(StatusCode::SERVICE_UNAVAILABLE, problem);
    }
    match tokio::time::timeout(LONGEST_WAIT_FOR_PICTURE, pictures.changed()).await {
        Ok(Ok(())) => {
            let jpeg = pictures.borrow().clone();
            ([(header::CONTENT_TYPE, "image/jpeg")], Body::from(jpeg)).into_response()
        }
        _ => fault(StatusCode::SERVICE_UNAVAILABLE, "the wall shows no picture yet"),
    }
}

async fn open_socket(
    State(hub): State<Arc<Hub>>,
    Extension(guest): Extension<Guest>,
    Extension(Peer(peer)): Extension<Peer>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Response {
    let upgrade = match upgrade {
        Ok(upgrade) => upgrade,
        Err(rejection) => return fault(rejection.status(), "this is a WebSocket: ask for an upgrade to one"),
    };
    let Some(remote) = socket::admit(&hub, guest.role, network(peer.ip())) else {
        return fault(StatusCode::SERVICE_UNAVAILABLE, "too many remotes are connected");
    };
    upgrade
        .protocols([PROTOCOL])
        .max_message_size(LONGEST_MESSAGE)
        .max_frame_size(LONGEST_MESSAGE)
        .read_buffer_size(LONGEST_MESSAGE)
        .write_buffer_size(0)
        .max_write_buffer_size(MOST_UNSENT)
        .on_upgrade(move |socket| socket::converse(socket, hub, guest, remote))
}

async fn metrics(State(hub): State<Arc<Hub>>, Extension(guest): Extension<Guest>) -> Response {
    if guest.role == Role::Visitor {
        return fault(StatusCode::FORBIDDEN, "this is for operators");
    }
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], hub.metrics()).into_response()
}

async fn health() -> Response {
    Json(json!({ "status": "ok" })).into_response()
}

#[cfg(test)]
mod tests {
    use serde_json::Value;
    use shared::{
        division::Division,
        protocol::{LightingMode, ShadingMode},
    };
    use strum::{VariantArray, VariantNames};

    use super::*;
    use crate::remote::{message::Action, state::WallState};

    fn openapi() -> Value {
        let (.., text) = PAGE.iter().find(|(path, ..)| *path == "/openapi.json").unwrap();
        serde_json::from_str(text).unwrap()
    }

    fn keys(value: &Value) -> Vec<&str> {
        let mut keys: Vec<_> = value.as_object().unwrap().keys().map(String::as_str).collect();
        keys.sort_unstable();
        keys
    }

    #[test]
    fn the_description_has_every_route_and_no_other() {
        let described = openapi();
        let mut routes: Vec<_> = guarded().iter().map(|(path, _)| *path).collect();
        routes.sort_unstable();
        assert_eq!(keys(&described["paths"]), routes);
        for (path, item) in described["paths"].as_object().unwrap() {
            let expected = if path == "/api/action" { "post" } else { "get" };
            assert_eq!(keys(item), [expected], "{path}");
            assert!(item[expected]["responses"]["401"].is_object(), "{path} tells nothing of strangers");
        }
    }

    #[test]
    fn the_description_has_every_action_with_an_example_that_is_one() {
        let described = openapi();
        let actions = described["components"]["schemas"]["Action"]["oneOf"].as_array().unwrap().clone();
        let name = |action: &Value| action["properties"]["do"]["const"].as_str().unwrap().to_owned();
        assert_eq!(actions.iter().map(name).collect::<Vec<_>>(), Action::VARIANTS);
        for action in actions {
            let example = &action["example"];
            let decoded = message::decode(example.to_string().as_bytes()).unwrap();
            assert_eq!(<&str>::from(&decoded.action), name(&action));
            assert!(keys(example).iter().all(|key| keys(&action["properties"]).contains(key)), "{example}");
        }
    }

    #[test]
    fn page_and_description_have_every_choice() {
        let described = openapi();
        let actions = described["components"]["schemas"]["Action"]["oneOf"].as_array().unwrap();
        let check = |name: &str, choices: Vec<String>| {
            let action = actions.iter().find(|action| action["properties"]["do"]["const"] == name).unwrap();
            let listed = action["properties"][name]["enum"].as_array().unwrap();
            let listed: Vec<_> = listed.iter().filter_map(Value::as_str).collect();
            assert_eq!(listed, choices, "{name}");
            let select =
                PAGE[0].2.split(&format!("<select id=\"{name}\">")).nth(1).unwrap().split("</select>").next().unwrap();
            let is_offered = |choice: &&String| {
                select.contains(&format!("<option>{choice}</option>"))
                    || select.contains(&format!("value=\"{choice}\""))
            };
            assert_eq!(choices.iter().filter(is_offered).count(), choices.len(), "{name}: {select}");
        };
        check("rays", LightingMode::VARIANTS.iter().map(ToString::to_string).collect());
        check("division", Division::VARIANTS.iter().map(ToString::to_string).collect());
        check("shading", ShadingMode::VARIANTS.iter().map(ToString::to_string).collect());
    }

    #[test]
    fn the_description_has_every_value_of_the_state() {
        let described = openapi();
        let state = serde_json::to_value(WallState::default()).unwrap();
        for part in ["show", "controls", "farm"] {
            assert_eq!(keys(&described["components"]["schemas"][part]["properties"]), keys(&state[part]), "{part}");
        }
    }

    #[test]
    fn a_token_comes_in_a_header() {
        let of = |name: HeaderName, value: &'static str| {
            let headers = HeaderMap::from_iter([(name, HeaderValue::from_static(value))]);
            token(&headers).map(str::to_owned)
        };
        assert_eq!(of(header::AUTHORIZATION, "Bearer abc").as_deref(), Some("abc"));
        assert_eq!(of(header::SEC_WEBSOCKET_PROTOCOL, "raywall, abc").as_deref(), Some("abc"));
        assert_eq!(of(header::SEC_WEBSOCKET_PROTOCOL, "raywall"), None);
        assert_eq!(of(header::AUTHORIZATION, "Basic abc"), None);
    }
}
