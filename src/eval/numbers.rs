//! Numbers as people read them; what has no value is a dash.

/// Three to four significant digits, no exponent where people would not write one.
pub fn number(value: f64) -> String {
    let size = value.abs();
    match size {
        _ if !value.is_finite() => "none".to_owned(),
        0.0 => "0".to_owned(),
        _ if !(1e-4..1e7).contains(&size) => format!("{value:.2e}"),
        _ if size >= 1000.0 => format!("{value:.0}"),
        _ if size >= 100.0 => format!("{value:.1}"),
        _ if size >= 1.0 => format!("{value:.2}"),
        _ if size >= 0.01 => format!("{value:.3}"),
        _ => format!("{value:.5}"),
    }
}

pub fn figure(value: Option<f64>) -> String {
    value
        .filter(|value| value.is_finite())
        .map_or_else(|| "–".to_owned(), number)
}

pub fn decibels(value: Option<f64>) -> String {
    value
        .filter(|value| value.is_finite())
        .map_or_else(|| "–".to_owned(), |value| format!("{value:.2}"))
}

pub fn milliseconds(value: Option<f64>) -> String {
    match value.filter(|value| value.is_finite()) {
        None => "–".to_owned(),
        Some(ms) if ms >= 1e4 => format!("{:.1} s", ms / 1e3),
        Some(ms) => format!("{ms:.0} ms"),
    }
}

pub fn mebibytes(value: Option<f64>) -> String {
    value
        .filter(|value| value.is_finite())
        .map_or_else(|| "–".to_owned(), |mib| format!("{mib:.0} MiB"))
}

/// 1234567 -> 1,234,567.
pub fn count(n: u64) -> String {
    let digits = n.to_string();
    let lead = digits.len() % 3;
    let groups = digits.as_bytes()[lead..]
        .chunks(3)
        .map(|group| String::from_utf8_lossy(group).into_owned());
    let head = (lead > 0).then(|| digits[..lead].to_owned());
    head.into_iter().chain(groups).collect::<Vec<_>>().join(",")
}

/// 1 -> 1st, 8 -> 8th.
pub fn ordinal(n: u64) -> String {
    let ending = match (n % 10, n % 100) {
        (_, 11..=13) => "th",
        (1, _) => "st",
        (2, _) => "nd",
        (3, _) => "rd",
        _ => "th",
    };
    format!("{n}{ending}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        let check = |value: f64, expected: &str| assert_eq!(number(value), expected);
        check(0.0, "0");
        check(0.000_25, "0.00025");
        check(0.0312, "0.031");
        check(24.125, "24.12");
        check(312.04, "312.0");
        check(58_312.4, "58312");
        check(1e-9, "1.00e-9");
        check(f64::INFINITY, "none");
        assert_eq!(
            [0, 7, 1000, 58_312, 1_234_567].map(count),
            ["0", "7", "1,000", "58,312", "1,234,567"]
        );
        assert_eq!(
            [1, 2, 3, 8, 11, 12, 21, 112].map(ordinal),
            ["1st", "2nd", "3rd", "8th", "11th", "12th", "21st", "112th"]
        );
        assert_eq!(
            (
                figure(None),
                decibels(Some(f64::NAN)),
                milliseconds(Some(12_345.0))
            ),
            ("–".into(), "–".into(), "12.3 s".into())
        );
    }
}
