"""A payload from two recordings, and what has changed on a running robot since when."""

from .payload import (
    FrictionDifference as FrictionDifference,
    PayloadEstimate as PayloadEstimate,
    PropertyEstimate as PropertyEstimate,
    identify_payload as identify_payload,
)
