//! Who may connect: by token, and by the page that the request comes from.

use std::net::IpAddr;

use axum::http::HeaderMap;
use axum::http::header::{COOKIE, HOST, ORIGIN};

pub(crate) const COOKIE_NAME: &str = "splat_mapper_token";

/// What a server asks of requests.
#[derive(Debug, Clone)]
pub(crate) struct Access {
    pub(crate) token: Option<String>,
}

impl Access {
    /// Whether a request names a host that is this machine's own: a page of somebody else's can make a name of its own lead here (DNS
    /// rebinding), and no address. With a token every name is good.
    pub(crate) fn is_host_fine(&self, headers: &HeaderMap) -> bool {
        if self.token.is_some() {
            return true;
        }
        let Some(host) = text(headers, &HOST) else {
            return false;
        };
        let name = without_port(host);
        let address = name.trim_start_matches('[').trim_end_matches(']');
        name == "localhost" || address.parse::<IpAddr>().is_ok()
    }

    /// Whether a WebSocket is opened by the server's own page, or by no page.
    pub(crate) fn is_origin_fine(headers: &HeaderMap) -> bool {
        let Some(origin) = text(headers, &ORIGIN) else {
            return !headers.contains_key(ORIGIN);
        };
        let site = origin.split_once("://").map(|(_, site)| site);
        site.is_some() && site == text(headers, &HOST)
    }

    /// By the query of the address (`token=T`) or by the cookie.
    pub(crate) fn is_token_fine(&self, headers: &HeaderMap, query: Option<&str>) -> bool {
        let Some(token) = &self.token else {
            return true;
        };
        let of_query = query
            .unwrap_or("")
            .split('&')
            .find_map(|pair| pair.strip_prefix("token="));
        let cookies = headers
            .get_all(COOKIE)
            .iter()
            .filter_map(|value| value.to_str().ok());
        let of_cookie = cookies.flat_map(|all| all.split(';')).find_map(|cookie| {
            let (name, value) = cookie.trim().split_once('=')?;
            (name == COOKIE_NAME).then_some(value)
        });
        [of_query, of_cookie]
            .into_iter()
            .flatten()
            .any(|given| is_equal(given, token))
    }
}

/// In a time that does not depend on where they differ.
fn is_equal(a: &str, b: &str) -> bool {
    let differ = a
        .bytes()
        .zip(b.bytes())
        .fold(0, |all, (a, b)| all | (a ^ b));
    a.len() == b.len() && differ == 0
}

fn text<'a>(headers: &'a HeaderMap, name: &axum::http::HeaderName) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|b| b.is_ascii_digit()) && !name.is_empty() => name,
        _ => host,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(&'static str, &str)]) -> HeaderMap {
        let pair = |(name, value): &(&'static str, &str)| {
            (
                axum::http::HeaderName::from_static(name),
                value.parse().unwrap(),
            )
        };
        pairs.iter().map(pair).collect()
    }

    #[test]
    fn without_a_token_only_addresses_and_localhost_are_hosts() {
        let open = Access { token: None };
        for host in [
            "localhost",
            "localhost:8080",
            "127.0.0.1:8080",
            "[::1]:8080",
            "192.168.1.7",
        ] {
            assert!(open.is_host_fine(&headers(&[("host", host)])), "{host}");
        }
        for host in [
            "evil.example",
            "evil.example:8080",
            "localhost.evil.example",
            "",
        ] {
            assert!(!open.is_host_fine(&headers(&[("host", host)])), "{host}");
        }
        assert!(!open.is_host_fine(&HeaderMap::new()));
        let closed = Access {
            token: Some("abc".to_owned()),
        };
        assert!(closed.is_host_fine(&headers(&[("host", "robot.local:8080")])));
    }

    #[test]
    fn a_page_of_another_site_opens_no_socket() {
        let fine = |origin: &str| {
            Access::is_origin_fine(&headers(&[("host", "localhost:8080"), ("origin", origin)]))
        };
        assert!(fine("http://localhost:8080"));
        assert!(fine("https://localhost:8080"));
        for origin in [
            "http://evil.example",
            "http://localhost:80801",
            "null",
            "http://localhost",
        ] {
            assert!(!fine(origin), "{origin}");
        }
        assert!(Access::is_origin_fine(&headers(&[(
            "host",
            "localhost:8080"
        )])));
    }

    #[test]
    fn tokens_come_by_query_or_cookie() {
        let closed = Access {
            token: Some("abc".to_owned()),
        };
        let fine =
            |cookie: &str, query| closed.is_token_fine(&headers(&[("cookie", cookie)]), query);
        assert!(fine("", Some("token=abc")));
        assert!(fine("", Some("a=b&token=abc")));
        assert!(fine("other=1; splat_mapper_token=abc", None));
        for (cookie, query) in [
            ("", None),
            ("", Some("token=ab")),
            ("", Some("token=abcd")),
            ("", Some("token=")),
            ("splat_mapper_token=abx", None),
            ("token=abc", None),
        ] {
            assert!(!fine(cookie, query), "{cookie} {query:?}");
        }
    }
}
