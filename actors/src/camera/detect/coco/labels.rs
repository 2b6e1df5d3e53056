//! COCO classes by id: 91 ids, of which 80 are in use.

/// Scores per anchor, with class 0 for background.
pub(in super::super) const CLASSES: usize = IDS + 1;
/// Largest id of a class.
pub(in super::super) const IDS: usize = 90;

/// Every class in use with its id.
pub(in super::super) fn all() -> impl Iterator<Item = (usize, &'static str)> {
    NAMES
        .iter()
        .enumerate()
        .map(|(index, name)| (index + 1, *name))
        .filter(|(_, name)| !name.is_empty())
}

/// Name of the class with that id, if it is in use.
pub fn name(id: usize) -> Option<&'static str> {
    NAMES
        .get(id.checked_sub(1)?)
        .copied()
        .filter(|name| !name.is_empty())
}

#[rustfmt::skip]
const NAMES: [&str; IDS] = [
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light",
    "fire hydrant", "", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep",
    "cow", "elephant", "bear", "zebra", "giraffe", "", "backpack", "umbrella", "", "",
    "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove",
    "skateboard", "surfboard", "tennis racket", "bottle", "", "wine glass", "cup", "fork", "knife", "spoon",
    "bowl", "banana", "apple", "sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut",
    "cake", "chair", "couch", "potted plant", "bed", "", "dining table", "", "", "toilet",
    "", "tv", "laptop", "mouse", "remote", "keyboard", "cell phone", "microwave", "oven", "toaster",
    "sink", "refrigerator", "", "book", "clock", "vase", "scissors", "teddy bear", "hair drier", "toothbrush",
];
