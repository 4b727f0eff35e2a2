//! All messages of an MCAP file as they are, whatever they carry.

use std::path::Path;

use crate::bag_file::BagFile;

/// One message.
#[derive(Debug, Clone, Copy)]
pub struct RawMessage<'a> {
    pub topic: &'a str,
    /// Of the schema, such as `sensor_msgs/msg/Image`.
    pub type_name: &'a str,
    /// CDR with its four byte header.
    pub payload: &'a [u8],
    /// When it was written, nanoseconds.
    pub log_nanos: i64,
}

/// Hands out the CDR messages of a file in their order until `on_message` says false -> how many there were. Of a damaged file those before the fault have
/// come when the error does.
pub fn read(
    path: &Path,
    mut on_message: impl FnMut(RawMessage<'_>) -> bool,
) -> Result<u64, String> {
    let mut file = BagFile::open(path)?;
    let mut n = 0;
    while let Some((channel, log_nanos)) = file.next_message()? {
        let Some(channel) = file.channels.get(&channel) else {
            continue;
        };
        if channel.message_encoding != "cdr" {
            continue;
        }
        n += 1;
        let message = RawMessage {
            topic: &channel.topic,
            type_name: &channel.type_name,
            payload: file.payload(),
            log_nanos,
        };
        if !on_message(message) {
            break;
        }
    }
    Ok(n)
}
