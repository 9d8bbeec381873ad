"""Answers to requests: a result code and a message for people, whatever happens."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from meslam_core.errors import MapError, OutputError
from meslam_interfaces.action import ExportMap

Code = ExportMap.Result
"""The codes of all services; CANCELLED is the action's alone."""


class RequestError(Exception):
    """A request that is refused, with the code of the answer."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


def answering(
    handler: Callable[[Any, Any], None], log: Callable[[str], object]
) -> Callable[[Any, Any], Any]:
    """A service callback that turns a handler's errors into result codes.

    Args:
        handler: fills the response to a request, and raises what goes wrong.
        log: takes the details of defects.
    """

    def callback(request: Any, response: Any) -> Any:
        try:
            response.result, response.message = Code.SUCCESS, "done"
            handler(request, response)
        except RequestError as error:
            response.result, response.message = error.code, str(error)
        except OutputError as error:
            response.result, response.message = Code.IO_ERROR, str(error)
        except MapError as error:
            response.result, response.message = Code.INVALID_DATA, str(error)
        except Exception:
            log(traceback.format_exc())
            response.result = Code.INTERNAL_ERROR
            response.message = "this is a defect of the server; its log has the details"
        return response

    return callback


@contextmanager
def exclusive(lock: threading.Lock, message: str) -> Iterator[None]:
    """Holds a lock, or refuses the request when somebody else does."""
    if not lock.acquire(blocking=False):
        raise RequestError(Code.BUSY, f"{message}; ask again later")
    try:
        yield
    finally:
        lock.release()
