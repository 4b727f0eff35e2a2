//! Small files of recordings and folders, read whole; their names in order.

use std::cmp::Ordering;
use std::io::Read;
use std::path::Path;

/// A whole file that must be small; devices and pipes are none.
pub(crate) fn read_small(path: &Path, max_bytes: u64) -> Result<Vec<u8>, String> {
    let metadata = std::fs::metadata(path).map_err(|e| e.to_string())?;
    if !metadata.is_file() {
        return Err("not a regular file".to_owned());
    }
    if metadata.len() > max_bytes {
        return Err(format!(
            "a file of {} bytes, at most {max_bytes} are read",
            metadata.len()
        ));
    }
    let mut bytes = Vec::new();
    let file = std::fs::File::open(path).map_err(|e| e.to_string())?;
    file.take(max_bytes)
        .read_to_end(&mut bytes)
        .map_err(|e| e.to_string())?;
    Ok(bytes)
}

/// Orders names as people count: `frame9` before `frame10`.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a, b);
    loop {
        let (digits_a, digits_b) = (leading_digits(a), leading_digits(b));
        let (char_a, char_b) = (a.chars().next(), b.chars().next());
        let order = if digits_a.is_empty() || digits_b.is_empty() {
            char_a.cmp(&char_b)
        } else {
            let (number_a, number_b) = (
                digits_a.trim_start_matches('0'),
                digits_b.trim_start_matches('0'),
            );
            number_a
                .len()
                .cmp(&number_b.len())
                .then_with(|| number_a.cmp(number_b))
        };
        let (Ordering::Equal, Some(char_a), Some(char_b)) = (order, char_a, char_b) else {
            return order;
        };
        a = &a[digits_a.len().max(char_a.len_utf8())..];
        b = &b[digits_b.len().max(char_b.len_utf8())..];
    }
}

fn leading_digits(text: &str) -> &str {
    &text[..text
        .find(|c: char| !c.is_ascii_digit())
        .unwrap_or(text.len())]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_as_people_count() {
        let mut names = [
            "f10.png",
            "f9.png",
            "f1.png",
            "e99.png",
            "f010b.png",
            "f.png",
            "f9",
        ];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(
            names,
            [
                "e99.png",
                "f.png",
                "f1.png",
                "f9",
                "f9.png",
                "f10.png",
                "f010b.png"
            ]
        );
    }
}
