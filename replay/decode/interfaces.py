"""Topics of services and actions, and the reasons why some of them are not decoded.

ROS 2 records the calls of a service on ``SERVICE/_service_event``, as ``package/srv/NAME_Event``,
and the progress of an action on ``ACTION/_action/feedback``, as
``package/action/NAME_FeedbackMessage``. Recorders seldom store complete definitions of these types.
"""

from typing import Final

from crosscue.replay.columns import Topic

SERVICE_EVENT: Final = "service event"
NO_FEEDBACK_DEFINITION: Final = "action feedback without a complete definition"
_FEEDBACK: Final = "_FeedbackMessage"


def is_service_event(topic: Topic) -> bool:
    """Return whether ``topic`` holds the calls of a service."""
    is_named_so = "/srv/" in topic.type_name or topic.name.endswith("/_service_event")
    return is_named_so and topic.type_name.endswith("_Event")


def is_feedback(topic: Topic) -> bool:
    """Return whether ``topic`` holds the feedback of an action."""
    return "/action/" in topic.type_name and topic.type_name.endswith(_FEEDBACK)


def why_not_decoded(topic: Topic, otherwise: str) -> str:
    """Return the reason for skipping the rows of a topic that has no decoder.

    Args:
        topic: The topic.
        otherwise: The reason for a topic that belongs to neither a service nor an action.
    """
    if is_service_event(topic):
        return SERVICE_EVENT
    return NO_FEEDBACK_DEFINITION if is_feedback(topic) else otherwise
