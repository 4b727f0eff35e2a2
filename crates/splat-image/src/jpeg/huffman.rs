//! The Huffman codes of a JPEG scan: bits out of bytes, symbols and the numbers behind them out of bits.
//!
//! Source: ITU-T T.81, annexes C and F. Knows nothing of blocks.

/// Codes of at most so many bits are found by one look.
const LOOK_BITS: u32 = 10;
/// Longest code.
const MAX_BITS: usize = 16;
/// Of an entry: its number is part of it.
const IS_WHOLE: u32 = 1 << 7;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Damage {
    /// Bits that start no code, or a symbol that has no meaning here.
    Code,
    /// A run of zeros that leaves its block.
    Run,
    /// The data ended before the image did.
    End,
    /// No restart marker where one is due.
    Restart,
}

/// One code's symbol, which says how many zeros come first, and the number behind them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Symbol {
    pub(crate) n_zeros: usize,
    /// Of the number; 0 for the symbols without one.
    pub(crate) n_bits: u32,
    pub(crate) number: i32,
}

/// The codes of one class and id.
#[derive(Debug, Clone)]
pub(crate) struct Table {
    /// By the next bits: their number in bits 0 to 4, `IS_WHOLE`, the symbol in 8 to 15, its number above. 0: too long.
    entries: Box<[u32; 1 << LOOK_BITS]>,
    /// Behind the last code of each length, which stands in the upper bits of sixteen.
    ends: [u32; MAX_BITS + 1],
    /// Place of a code's symbol, less the code.
    places: [i32; MAX_BITS + 1],
    symbols: [u8; 256],
}

impl Default for Table {
    fn default() -> Self {
        Self {
            entries: Box::new([0; 1 << LOOK_BITS]),
            ends: [0; MAX_BITS + 1],
            places: [0; MAX_BITS + 1],
            symbols: [0; 256],
        }
    }
}

impl Table {
    /// Takes the place of what it was. `n_codes`: of 1 to 16 bits. `None`: no prefix code has such lengths.
    pub(crate) fn set(&mut self, n_codes: &[u8; MAX_BITS], symbols: &[u8]) -> Option<()> {
        self.entries.fill(0);
        self.symbols
            .get_mut(..symbols.len())?
            .copy_from_slice(symbols);
        let mut code = 0_u32;
        let mut place = 0;
        for (length, &n_codes) in (1_u32..).zip(n_codes) {
            let n_codes = u32::from(n_codes);
            code <<= 1;
            self.places[length as usize] = place - code as i32;
            if code + n_codes > 1 << length {
                return None;
            }
            for _ in 0..n_codes {
                let symbol = *symbols.get(place as usize)?;
                self.note(code, length, symbol);
                code += 1;
                place += 1;
            }
            self.ends[length as usize] = code << (MAX_BITS as u32 - length);
        }
        (place as usize == symbols.len()).then_some(())
    }

    fn note(&mut self, code: u32, length: u32, symbol: u8) {
        let Some(n_free) = LOOK_BITS.checked_sub(length) else {
            return;
        };
        let n_bits = u32::from(symbol & 15);
        let first = code << n_free;
        for rest in 0..1 << n_free {
            let upper = u32::from(symbol) << 8;
            let is_whole = n_bits > 0 && n_bits <= n_free;
            self.entries[(first + rest) as usize] = if is_whole {
                let number = signed(rest >> (n_free - n_bits), n_bits);
                (number as u32) << 16 | upper | IS_WHOLE | (length + n_bits)
            } else {
                upper | length
            };
        }
    }

    #[inline(always)]
    pub(crate) fn next(&self, bits: &mut Bits<'_>) -> Result<Symbol, Damage> {
        bits.fill();
        let entry = self.entries[bits.peek(LOOK_BITS) as usize];
        let length = entry & 31;
        let symbol = if length == 0 {
            self.long(bits)?
        } else {
            bits.skip(length);
            (entry >> 8) as u8
        };
        let n_bits = u32::from(symbol & 15);
        let number = if entry & IS_WHOLE != 0 {
            entry as i32 >> 16
        } else if n_bits == 0 {
            0
        } else {
            let number = signed(bits.peek(n_bits), n_bits);
            bits.skip(n_bits);
            number
        };
        Ok(Symbol {
            n_zeros: usize::from(symbol >> 4),
            n_bits,
            number,
        })
    }

    #[cold]
    fn long(&self, bits: &mut Bits<'_>) -> Result<u8, Damage> {
        let code = bits.peek(MAX_BITS as u32);
        let length = (LOOK_BITS as usize + 1..=MAX_BITS)
            .find(|&length| code < self.ends[length])
            .ok_or(Damage::Code)?;
        bits.skip(length as u32);
        let place = (code >> (MAX_BITS - length)) as i32 + self.places[length];
        self.symbols
            .get(place as usize)
            .copied()
            .ok_or(Damage::Code)
    }
}

/// T.81, F.2.2.1: the lower half of the numbers of so many bits is negative.
#[inline(always)]
fn signed(bits: u32, n_bits: u32) -> i32 {
    let is_negative = bits >> (n_bits - 1) == 0;
    bits as i32 - if is_negative { (1 << n_bits) - 1 } else { 0 }
}

/// The bits of a scan. Behind its data come zeros without end, and the count of those.
#[derive(Debug)]
pub(crate) struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
    /// The next ones, from the highest downwards.
    held: u64,
    n_held: u32,
    n_padded: u32,
}

impl<'a> Bits<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            at: 0,
            held: 0,
            n_held: 0,
            n_padded: 0,
        }
    }

    /// At least 32 are held, which is a code and its number.
    #[inline(always)]
    fn fill(&mut self) {
        if self.n_held >= 32 {
            return;
        }
        let four = self.bytes.get(self.at..self.at + 4);
        let word = four.map_or(u32::MAX, |four| {
            u32::from_be_bytes(four.try_into().expect("four bytes"))
        });
        if has_ff(word) {
            self.fill_by_bytes();
            return;
        }
        self.held |= u64::from(word) << (32 - self.n_held);
        self.n_held += 32;
        self.at += 4;
    }

    #[cold]
    fn fill_by_bytes(&mut self) {
        while self.n_held <= 56 {
            let byte = match (self.bytes.get(self.at), self.bytes.get(self.at + 1)) {
                (Some(0xff), Some(0)) => {
                    self.at += 2;
                    0xff
                }
                (None | Some(0xff), _) => {
                    self.n_padded += 8;
                    0
                }
                (Some(&byte), _) => {
                    self.at += 1;
                    byte
                }
            };
            self.held |= u64::from(byte) << (56 - self.n_held);
            self.n_held += 8;
        }
    }

    #[inline(always)]
    fn peek(&self, n_bits: u32) -> u32 {
        (self.held >> (64 - n_bits)) as u32
    }

    #[inline(always)]
    fn skip(&mut self, n_bits: u32) {
        self.held <<= n_bits;
        self.n_held -= n_bits;
    }

    /// An error once more was read than there is.
    #[inline(always)]
    pub(crate) fn check(&self) -> Result<(), Damage> {
        if self.n_held < self.n_padded {
            return Err(Damage::End);
        }
        Ok(())
    }

    /// Steps behind the restart marker that must come next. `ix`: how many came before.
    pub(crate) fn restart(&mut self, ix: usize) -> Result<(), Damage> {
        let n_left = self.n_held - self.n_padded;
        while self.bytes.get(self.at..self.at + 2) == Some(&[0xff, 0xff]) {
            self.at += 1;
        }
        let marker = [0xff, 0xd0 + (ix % 8) as u8];
        if n_left >= 8 || self.bytes.get(self.at..self.at + 2) != Some(&marker) {
            return Err(Damage::Restart);
        }
        *self = Self {
            at: self.at + 2,
            ..Self::new(self.bytes)
        };
        Ok(())
    }
}

#[inline(always)]
fn has_ff(word: u32) -> bool {
    let inverse = !word;
    inverse.wrapping_sub(0x0101_0101) & word & 0x8080_8080 != 0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two codes of two bits, one of three, one of twelve.
    fn table() -> Table {
        let mut table = Table::default();
        let mut n_codes = [0; MAX_BITS];
        n_codes[1] = 2;
        n_codes[2] = 1;
        n_codes[11] = 1;
        table.set(&n_codes, &[0x01, 0x23, 0x00, 0xf0]).unwrap();
        table
    }

    #[test]
    fn codes_short_and_long_give_their_symbols_and_numbers() {
        // 00 1 | 01 010 | 100 | 101000000000 | 00 0, then ones.
        let bytes = [0b0010_1010, 0b1001_0100, 0b0000_0000, 0b0011_1111];
        let mut bits = Bits::new(&bytes);
        let table = table();
        let mut next = || {
            let symbol = table.next(&mut bits).unwrap();
            (symbol.n_zeros, symbol.n_bits, symbol.number)
        };
        assert_eq!(next(), (0, 1, 1));
        assert_eq!(next(), (2, 3, -5));
        assert_eq!(next(), (0, 0, 0));
        assert_eq!(next(), (15, 0, 0));
        assert_eq!(next(), (0, 1, -1));
        assert_eq!(table.next(&mut bits), Err(Damage::Code));
    }

    #[test]
    fn stuffed_bytes_count_once_and_reading_past_the_end_is_noticed() {
        let bytes = [0xff, 0, 0x12, 0xff, 0, 0xff, 0xd9];
        let mut bits = Bits::new(&bytes);
        for expected in [0xff, 0x12, 0xff] {
            bits.fill();
            assert_eq!(bits.peek(8), expected);
            bits.skip(8);
            bits.check().unwrap();
        }
        bits.fill();
        bits.skip(1);
        assert_eq!(bits.check(), Err(Damage::End));
    }

    #[test]
    fn a_restart_is_taken_where_it_is_due_and_missed_where_it_is_not() {
        let bytes = [0x12, 0xff, 0xff, 0xd1, 0x34];
        let read = |ix| {
            let mut bits = Bits::new(&bytes);
            bits.fill();
            bits.skip(5);
            bits.restart(ix).map(|()| {
                bits.fill();
                bits.peek(8)
            })
        };
        assert_eq!(read(1), Ok(0x34));
        assert_eq!(read(9), Ok(0x34));
        assert_eq!(read(2), Err(Damage::Restart));
        assert_eq!(Bits::new(&bytes[..1]).restart(0), Err(Damage::Restart));
    }

    #[test]
    fn lengths_that_no_code_has_are_refused() {
        let mut n_codes = [0; MAX_BITS];
        n_codes[0] = 3;
        assert!(Table::default().set(&n_codes, &[1, 2, 3]).is_none());
        n_codes[0] = 1;
        assert!(Table::default().set(&n_codes, &[1, 2]).is_none());
        assert!(Table::default().set(&n_codes, &[]).is_none());
        n_codes[7] = 255;
        assert!(Table::default().set(&n_codes, &[0; 256]).is_none());
    }
}
