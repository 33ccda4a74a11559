"""Topics that belong to a service or an action: which of them hold data, and why others do not.

ROS 2 records the calls of a service on ``SERVICE/_service_event``, as ``package/srv/NAME_Event``,
and the progress of an action on ``ACTION/_action/feedback``, as
``package/action/NAME_FeedbackMessage``.
Recorders seldom store a definition that these types can be read with.
"""

from __future__ import annotations

from typing import Final

from crosscue.replay.columns import Topic

SERVICE_EVENT: Final = "service event"
NO_FEEDBACK_DEFINITION: Final = "action feedback without a complete definition"
_FEEDBACK: Final = "_FeedbackMessage"


def is_service_event(topic: Topic) -> bool:
    """Does ``topic`` hold the calls of a service?"""
    is_named_so = "/srv/" in topic.type_name or topic.name.endswith("/_service_event")
    return is_named_so and topic.type_name.endswith("_Event")


def is_feedback(topic: Topic) -> bool:
    """Does ``topic`` hold the feedback of an action?"""
    return "/action/" in topic.type_name and topic.type_name.endswith(_FEEDBACK)


def why_not_decoded(topic: Topic, otherwise: str) -> str:
    """The reason for which rows of a topic that has no decoder are skipped.

    Args:
        topic: The topic.
        otherwise: The reason if it belongs to no service and to no action.
    """
    if is_service_event(topic):
        return SERVICE_EVENT
    return NO_FEEDBACK_DEFINITION if is_feedback(topic) else otherwise
