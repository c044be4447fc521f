"""The pages of the list of tasks."""

from __future__ import annotations

from a2a.types import ListTasksRequest, ListTasksResponse, Task, TaskState
from a2a.utils.errors import InvalidParamsError

DEFAULT_PAGE = 50
LARGEST_PAGE = 100


def page_of(tasks: list[Task], request: ListTasksRequest) -> ListTasksResponse:
    """Return the page of a list that a request asks for: the newest tasks first.

    Raises:
        InvalidParamsError: The size or the token of the page is invalid.
    """
    size = request.page_size if request.HasField("page_size") else DEFAULT_PAGE
    if not 0 < size <= LARGEST_PAGE:
        raise InvalidParamsError(f"pageSize is between 1 and {LARGEST_PAGE}, not {size}")
    wanted = [task for task in tasks if _is_wanted(task, request)]
    wanted.sort(key=_key, reverse=True)
    rest = wanted
    if token := request.page_token:
        time, _, task_id = token.partition("-")
        if not time.isdecimal() or len(time) > 20:
            raise InvalidParamsError("pageToken is the nextPageToken of the page before")
        rest = [task for task in wanted if _key(task) < (int(time), task_id)]
    page = rest[:size]
    more = f"{_key(page[-1])[0]}-{page[-1].id}" if len(rest) > size else ""
    return ListTasksResponse(
        tasks=page, next_page_token=more, page_size=size, total_size=len(wanted)
    )


def _is_wanted(task: Task, request: ListTasksRequest) -> bool:
    if request.context_id and request.context_id != task.context_id:
        return False
    if request.status not in (TaskState.TASK_STATE_UNSPECIFIED, task.status.state):
        return False
    after = request.status_timestamp_after.ToMilliseconds()
    return not after or task.status.timestamp.ToMilliseconds() >= after


def _key(task: Task) -> tuple[int, str]:
    return task.status.timestamp.ToMilliseconds(), task.id
