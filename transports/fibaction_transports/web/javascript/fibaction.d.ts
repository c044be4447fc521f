/** A client of fibaction: send, follow and cancel the goals of a robot, from browsers and Node. */

export type Status =
  | "UNKNOWN" | "ACCEPTED" | "EXECUTING" | "CANCELING" | "SUCCEEDED" | "CANCELED" | "ABORTED";

/**
 * The state of a connection: `lost` while it is opened again, `closed` after `close()` and after an
 * error that would come again, such as a token that is not valid.
 */
export type State = "connecting" | "ready" | "lost" | "closed";

/** The types of one action. */
export interface ActionTypes {
  goal: unknown;
  feedback: unknown;
  result: unknown;
}

/** The types of an action that is only known by its name. */
export interface AnyAction {
  goal: any;
  feedback: any;
  result: any;
}

/** The type that a program has named, or that of the action of a name. */
type TypesOf<Actions, Name extends keyof Actions, Named> =
  { named: Named; found: Actions[Name] }[[Named] extends [never] ? "found" : "named"];

/** A class of WebSocket, for a program whose platform has none. */
export type WebSocketClass = new (url: string, protocol: string) => any;

export interface ConnectionOptions {
  /** The access token, which is sent inside of the connection. */
  token?: string;
  /** Called with each new state. */
  onstate?: ((state: State) => void) | null;
  /** Seconds for which calls wait for a lost server, 30 by default. The attempts go on after that. */
  reconnectTimeout?: number;
  /** The class of WebSocket, if the platform has none: for example that of `ws`, in Node 20. */
  WebSocket?: WebSocketClass;
}

export interface SendOptions {
  /** The goal's ID, 32 hex digits: the same goal with the same ID runs once. Random by default. */
  id?: string;
  /** Cancels the goal when it is aborted. */
  signal?: AbortSignal;
  /** False if the feedback is not wanted. */
  feedback?: boolean;
  /** Labels of the goal, to find it again: `{ order: "17" }`. */
  labels?: Record<string, string>;
  /** Other text that goes with the goal: its trace, `{ traceparent }`. */
  meta?: Record<string, string>;
}

/** A goal that needs no field may be left out. */
export type SendArguments<Goal> = {} extends Goal
  ? [goal?: Goal, options?: SendOptions]
  : [goal: Goal, options?: SendOptions];

export interface AttachOptions {
  /** Number of the feedback after which to begin: 0 for all that is kept; the next by default. */
  after?: number | null;
  /** The attempt that `after` counts in. */
  attempt?: number;
  /** True to follow as an observer, for which the executor never waits. */
  observe?: boolean;
  /** False if the feedback is not wanted. */
  feedback?: boolean;
}

/** An action that is served, with the JSON Schemas of its types. */
export interface ActionInfo {
  name: string;
  /** The ROS 2 type; empty if it has none. */
  typeName: string;
  goal: Record<string, any>;
  feedback: Record<string, any>;
  result: Record<string, any>;
}

export interface CanceledGoal {
  id: string;
  /** Time when the goal was accepted: nanoseconds since 1970, by the server's clock. */
  stamp: bigint;
  status: Status;
}

/** A goal in the list of all goals. */
export interface GoalInfo extends CanceledGoal {
  /** Feedback messages so far. */
  feedbackCount: number;
  /** Name of the client that sent the goal; empty if the server does not know it. */
  client: string;
  /** Place among the goals that wait, from 1; 0 if it does not wait. */
  place: number;
  queueLength: number;
  attempt: number;
  /** The goal whose executor has sent this one, and the name of the step; null if there is none. */
  parent: { id: string; step: string } | null;
  /** Time when its first attempt began, as `stamp`; null if it has not begun, or if the server does not tell it. */
  beganAt: bigint | null;
  /** Time of the end; null if it is active, or if the server does not tell it. */
  endedAt: bigint | null;
  /** Reason of an abort or a cancel; may be empty. */
  reason: string;
  /** Labels that its client has given it; empty if there are none. */
  labels: Record<string, string>;
  /** Name of the worker of a fleet that has it, or had it at its end; empty if there is none. */
  worker: string;
  /** Changes that were left out so far, because the client read too slowly. */
  dropped: number;
}

export interface Outcome<Result = any> {
  /** UNKNOWN if the server does not know the goal any more. */
  status: Status;
  /** The result; null if there is none. */
  result: Result | null;
  /** Why it ended like that, for a person; may be empty. */
  reason: string;
  /** Feedback messages that did not come. */
  feedbackDropped: number;
}

export interface Goal<Action extends ActionTypes = AnyAction> {
  readonly action: string;
  /** The ID: 32 hex digits. */
  readonly id: string;
  /** Time when the goal was accepted: nanoseconds since 1970, by the server's clock. */
  readonly stamp: bigint;
  /** The goal itself; null for one of another client, if the server does not tell it. */
  readonly goal: Action["goal"] | null;
  /** Labels that its client has given it; empty if there are none. */
  readonly labels: Readonly<Record<string, string>>;
  /**
   * Last checkpoint of a goal that its server has given up and can run again, as it was when this
   * client attached; null if it has none, undefined for any other goal. Only clients that may
   * observe the action are told it.
   */
  readonly checkpoint?: any;
  readonly status: Status;
  onstatus: ((status: Status) => void) | null;
  /** Number of the feedback that was read last, which `attach` takes as `after`. */
  readonly number: number;
  /** The attempt that `number` counts in. */
  readonly attempt: number;
  /**
   * Time when the executor reported that feedback, as `stamp`; 0 before the first. Where the server
   * does not tell it, as one of ROS, it is the time of the arrival here or at a bridge.
   */
  readonly at: bigint;
  /**
   * The feedback, for one `for await`, which ends with the goal. While it is read slowly, the
   * executor waits or the oldest is lost, as the server's policy says. To leave the loop is to stop
   * the feedback; the outcome still comes.
   */
  readonly feedback: AsyncIterableIterator<Action["feedback"]>;
  /** The outcome. Rejects with `ConnectionLost` if the server stays away. */
  readonly outcome: Promise<Outcome<Action["result"]>>;
  /** Cancel the goal. Rejects with `CancelRefused`. */
  cancel(): Promise<CanceledGoal[]>;
  /** Follow the goal no longer. It goes on. */
  leave(): void;
}

/**
 * A connection to a server, which is opened again whenever it is lost, and goes on with its goals.
 *
 * `Actions` has the types of each action by its name, as `fibaction gen --ts` writes it. With
 * `new Connection<Actions>(url)`, an editor completes the names, and each name has its types.
 */
export class Connection<
  Actions extends { [Name in keyof Actions]: ActionTypes } = Record<string, AnyAction>,
> {
  /** Connect to `ws://`, `wss://`, `http://` or `https://`, or to a URL relative to the page's. */
  constructor(url: string | URL, options?: ConnectionOptions);
  readonly url: string;
  readonly state: State;
  onstate: ((state: State) => void) | null;
  /** Resolves when the server has answered; rejects if it has not for `reconnectTimeout`. */
  readonly ready: Promise<void>;
  /** The actions that the server has now. */
  actions(): Promise<ActionInfo[]>;
  /**
   * Send a goal. Rejects with `GoalRejected`. Its types are those of the name in `Actions`, or
   * those that you name: `sendGoal<Fibonacci>(...)`.
   */
  sendGoal<
    Named extends ActionTypes = never,
    Name extends keyof Actions & string = keyof Actions & string,
  >(
    action: Name, ...rest: SendArguments<TypesOf<Actions, Name, Named>["goal"]>
  ): Promise<Goal<TypesOf<Actions, Name, Named>>>;
  /** Follow a goal that was sent before, by any client. */
  attach<
    Named extends ActionTypes = never,
    Name extends keyof Actions & string = keyof Actions & string,
  >(
    action: Name, id: string, options?: AttachOptions,
  ): Promise<Goal<TypesOf<Actions, Name, Named>>>;
  /** Cancel one goal, those accepted until a stamp, or all. Rejects with `CancelRefused`. */
  cancel(
    action: keyof Actions & string, goals?: { id?: string; before?: bigint | null },
  ): Promise<CanceledGoal[]>;
  /**
   * Call back with every goal of an action and each change, again after each reconnection and each
   * restart of its server; the function that it returns stops that. A goal that the server has
   * forgotten comes as UNKNOWN.
   */
  watch(
    action: keyof Actions & string, callback: (goal: GoalInfo) => void,
    onerror?: (error: Error) => void,
  ): () => void;
  /**
   * Send another request of the protocol: its tag, and its fields after the ID. The answer is the
   * fields of the server's answer; for a page of the history (tag 20), it is a list of `GoalInfo`.
   */
  request(tag: number, ...fields: unknown[]): Promise<any[]>;
  close(): void;
}

/** The base class of all errors of this module; its `name` says which one it is. */
export class ActionError extends Error {}
export class ConnectionLost extends ActionError {}
export class ProtocolError extends ActionError {}
export class GoalRejected extends ActionError {
  readonly reason: string;
}
export class CancelRefused extends ActionError {
  /** 1: rejected; 2: the goal is unknown; 3: it has ended. */
  readonly code: 1 | 2 | 3;
  readonly reason: string;
}

/** Return a value as msgpack. Uint8Array becomes `bin`, a fraction `float`, undefined is left out. */
export function encode(value: unknown): Uint8Array;
/** Return the value of msgpack bytes. An integer beyond 2^53 is a BigInt. */
export function decode(bytes: Uint8Array): any;
