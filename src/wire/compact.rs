//! The compact encoding: CBOR with structs as arrays and with rounded numbers of few bytes.
//!
//! `#[n(…)]` is the field's array index. The meaning of an index is fixed; new fields are appended.
//! An absent field is null, or left out at the end; readers skip unknown indices. Readers accept an
//! integer or a float of any width; the field's [`Form`] determines how a number is written.

mod number;

use std::collections::BTreeMap;

use minicbor::data::Type;
use minicbor::decode::{self, Decode, Decoder};
use minicbor::encode::{self, Encode, Encoder, Write};
use uuid::Uuid;

pub(crate) use number::{CovarianceForm, Half, Millimetres, Single};

use super::RejectReason;
use super::numbers::compact_with_integers;
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;

/// True if the first byte of a payload starts a compact payload: an array. JSON and CBOR with names
/// start with a map.
pub(super) fn is_compact(first: u8) -> bool {
    const ARRAY: u8 = 4;
    first >> 5 == ARRAY
}

#[expect(clippy::expect_used, reason = "writing to memory does not fail")]
pub(super) fn write<T: Encode<()>>(payload: &T, bytes: &mut Vec<u8>) {
    minicbor::encode(payload, bytes).expect("payloads are written into memory");
}

/// Reads a payload that fills all of `bytes`, with numbers in any form.
pub(super) fn read<T: for<'b> Decode<'b, ()>>(bytes: &[u8]) -> Result<T, RejectReason> {
    read_exactly(bytes).or_else(|reason| match compact_with_integers(bytes) {
        Some(bytes) => read_exactly(&bytes),
        None => Err(reason),
    })
}

fn read_exactly<T: for<'b> Decode<'b, ()>>(bytes: &[u8]) -> Result<T, RejectReason> {
    let mut decoder = Decoder::new(bytes);
    let payload = decoder.decode().map_err(|_| RejectReason::Malformed)?;
    if decoder.position() == bytes.len() {
        Ok(payload)
    } else {
        Err(RejectReason::Malformed)
    }
}

/// The `schema` of a payload that may be of a later version; it is always the first field.
pub(super) fn schema(bytes: &[u8]) -> Option<u32> {
    let mut decoder = Decoder::new(bytes);
    decoder.array().ok()?;
    decoder.u32().ok()
}

/// A written form of values of type `T`, for types with several forms or without a form in
/// minicbor.
pub(crate) trait Form<T> {
    fn encode<C, W: Write>(
        value: &T,
        e: &mut Encoder<W>,
        context: &mut C,
    ) -> Result<(), encode::Error<W::Error>>;

    fn decode<C>(d: &mut Decoder<'_>, context: &mut C) -> Result<T, decode::Error>;

    /// The value of an absent field, if it may be absent.
    fn nil() -> Option<T> {
        None
    }

    /// True if the field is left out.
    fn is_nil(_value: &T) -> bool {
        false
    }
}

/// A label or an id as a text string.
pub(crate) struct Text;

impl Form<Label> for Text {
    fn encode<C, W: Write>(
        value: &Label,
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.str(value)?.ok()
    }

    fn decode<C>(d: &mut Decoder<'_>, _: &mut C) -> Result<Label, decode::Error> {
        d.str().map(Label::from)
    }
}

/// The 16 bytes of a UUID.
pub(crate) struct UuidBytes;

impl Form<Uuid> for UuidBytes {
    fn encode<C, W: Write>(
        value: &Uuid,
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.bytes(value.as_bytes())?.ok()
    }

    fn decode<C>(d: &mut Decoder<'_>, _: &mut C) -> Result<Uuid, decode::Error> {
        Uuid::from_slice(d.bytes()?).map_err(|_| decode::Error::message("an id has 16 bytes"))
    }
}

/// Collections that are left out when they are empty.
pub(crate) mod skip_empty {
    use super::{Decode, Decoder, Encode, Encoder, Type, Write, decode, encode};

    pub(crate) fn encode<C, T: Encode<()>, W: Write>(
        value: &T,
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.encode(value)?.ok()
    }

    pub(crate) fn decode<'b, C, T: Decode<'b, ()> + Default>(
        d: &mut Decoder<'b>,
        _: &mut C,
    ) -> Result<T, decode::Error> {
        match d.datatype()? {
            Type::Null => d.null().map(|()| T::default()),
            _ => d.decode(),
        }
    }

    pub(crate) fn nil<T: Default>() -> Option<T> {
        Some(T::default())
    }

    pub(crate) fn is_nil<T: Default + PartialEq>(value: &T) -> bool {
        *value == T::default()
    }
}

impl<T, F: Form<T>> Form<Option<T>> for F {
    fn encode<C, W: Write>(
        value: &Option<T>,
        e: &mut Encoder<W>,
        context: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        match value {
            Some(value) => F::encode(value, e, context),
            None => e.null()?.ok(),
        }
    }

    fn decode<C>(d: &mut Decoder<'_>, context: &mut C) -> Result<Option<T>, decode::Error> {
        match d.datatype()? {
            Type::Null => d.null().map(|()| None),
            _ => F::decode(d, context).map(Some),
        }
    }

    fn nil() -> Option<Option<T>> {
        Some(None)
    }

    fn is_nil(value: &Option<T>) -> bool {
        value.is_none()
    }
}

impl<T, F: Form<T>> Form<Vec<T>> for F {
    fn encode<C, W: Write>(
        values: &Vec<T>,
        e: &mut Encoder<W>,
        context: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.array(values.len() as u64)?;
        values
            .iter()
            .try_for_each(|value| F::encode(value, e, context))
    }

    fn decode<C>(d: &mut Decoder<'_>, context: &mut C) -> Result<Vec<T>, decode::Error> {
        let count = d.array()?;
        let mut values = Vec::new();
        while has_more(d, count, values.len())? {
            values.push(F::decode(d, context)?);
        }
        Ok(values)
    }
}

impl<F: Form<f64>> Form<BTreeMap<Label, f64>> for F {
    fn encode<C, W: Write>(
        values: &BTreeMap<Label, f64>,
        e: &mut Encoder<W>,
        context: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.map(values.len() as u64)?;
        values.iter().try_for_each(|(label, value)| {
            e.str(label)?;
            F::encode(value, e, context)
        })
    }

    fn decode<C>(
        d: &mut Decoder<'_>,
        context: &mut C,
    ) -> Result<BTreeMap<Label, f64>, decode::Error> {
        let count = d.map()?;
        let mut values = BTreeMap::new();
        let mut read = 0;
        while has_more(d, count, read)? {
            values.insert(d.str()?.into(), F::decode(d, context)?);
            read += 1;
        }
        Ok(values)
    }

    fn nil() -> Option<BTreeMap<Label, f64>> {
        Some(BTreeMap::new())
    }

    fn is_nil(values: &BTreeMap<Label, f64>) -> bool {
        values.is_empty()
    }
}

/// True if a collection has more entries than `read`; one without a count ends with a break.
fn has_more(d: &mut Decoder<'_>, count: Option<u64>, read: usize) -> Result<bool, decode::Error> {
    match count {
        Some(count) => Ok((read as u64) < count),
        None if d.datatype()? == Type::Break => d.skip().map(|()| false),
        None => Ok(true),
    }
}

impl<C> Encode<C> for NodeName {
    fn encode<W: Write>(
        &self,
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.str(self.as_str())?.ok()
    }
}

impl<C> Decode<'_, C> for NodeName {
    fn decode(d: &mut Decoder<'_>, _: &mut C) -> Result<Self, decode::Error> {
        Self::new(d.str()?).map_err(|_| decode::Error::message("not a name"))
    }
}

impl<C> Encode<C> for Timestamp {
    fn encode<W: Write>(
        &self,
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.u64(self.micros())?.ok()
    }
}

impl<C> Decode<'_, C> for Timestamp {
    fn decode(d: &mut Decoder<'_>, _: &mut C) -> Result<Self, decode::Error> {
        d.u64().map(Self)
    }
}

#[cfg(test)]
mod tests;
